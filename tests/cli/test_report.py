"""``qs3 report`` on a run, on several, on records; and what it refuses."""

import json
import re
import shutil
from pathlib import Path

import pytest
import tyro

import qs3.cli.report as cli
from qs3.cli.report import ReportOptions, command_of
from qs3.cli.report_runs import look
from qs3.errors import InputError


def report(*arguments, code=0):
    """The verb in this process, which need not import everything again for each page."""
    options = tyro.cli(ReportOptions, args=list(map(str, arguments)))
    assert cli.report(options) == code


def refusal(capsys, *arguments):
    """The one line with which the verb refuses."""
    capsys.readouterr()
    with pytest.raises(InputError) as refused:
        report(*arguments)
    assert capsys.readouterr().out == ""
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.fixture(scope="module")
def grid(qs3, store, run, tmp_path_factory):
    """A folder with a source-only run, one that it warmed up, their data and their records."""
    folder = tmp_path_factory.mktemp("grid")
    shutil.copytree(store, folder / "shapes")
    shutil.copytree(run, folder / "first")
    qs3("train", "--source", store, "--target", store, "--method", "qbst", "--warm-up", run,
        "--out", folder / "second", "--model", "pointnet", "--num-points", 64, "--epochs", 2,
        "--batch-size", 5, "--threads", 1, "--self-training.threshold", 0.0,
        "--self-training.rounds", 2, "--self-training.epochs", 1)  # fmt: skip
    for name in ("first", "second"):
        qs3("evaluate", folder / name, "--data", folder / "shapes")
    return folder


@pytest.fixture(scope="module")
def page(qs3, grid, tmp_path_factory):
    """The page of the whole grid, with the scan's pictures left out."""
    out = tmp_path_factory.mktemp("page") / "page.html"
    done = qs3("report", grid, "--mesh", "none", "--out", out)
    assert done.stdout == f"{out}\n"
    return out.read_text("utf-8")


def headings(text):
    return re.findall(r"<h2>(.*?)</h2>", text)


def test_page_of_several_runs_has_every_part(page):
    """The adapted run is told in full, its warm-up and its data are found by themselves."""
    assert headings(page) == [
        "Sample clouds",
        "Training",
        "Features of both domains",
        "What self-training selected",
        "Before and after",
        "All records",
        "Data",
        "Settings and versions",
        "How to make it again",
    ]
    assert re.findall(r'<div class="score">([\w-]+)<b>', page) == ["source-only", "qbst"]
    assert "Transductive: the network adapted to clouds that it is scored on" in page
    assert "It is second, one of 2 runs" in page
    assert len(re.findall(r'<i data-class="\d+"', page)) == 20
    assert re.search(r'data-note="Taken for \w+ \(source-only\), \w+ \(qbst\)"', page)


@pytest.mark.slow
def test_same_input_gives_the_same_bytes_and_no_path_of_this_machine(capsys, grid, page, tmp_path):
    again = tmp_path / "again.html"
    report(grid, "--mesh", "none", "--out", again)
    assert again.read_text("utf-8") == page
    assert [p.name for p in tmp_path.iterdir()] == ["again.html"]
    assert str(grid) not in page


@pytest.mark.slow
def test_page_of_one_run_lands_in_its_folder_with_the_scan_step_by_step(capsys, grid, tmp_path):
    folder = tmp_path / "plain"
    shutil.copytree(grid / "first", folder)
    report(folder, "--data", grid / "shapes")
    assert capsys.readouterr().out == f"{folder / 'report.html'}\n"
    text = (folder / "report.html").read_text("utf-8")
    assert headings(text)[:2] == ["From mesh to cloud", "Sample clouds"]
    assert "What it takes for what" in text  # one network: no before and after
    assert 'id="verdict"' not in text
    assert "Training clouds: the network learnt from labels of clouds" in text


def test_records_alone_make_tables_and_no_clouds(grid, tmp_path):
    for name in ("first", "second"):
        for record in (grid / name / "records").iterdir():
            shutil.copy(record, tmp_path / f"S-D_{name}_seed-0.json")
    shutil.move(tmp_path / "S-D_second_seed-0.json", tmp_path / "S-D_qbst_seed-0.json")
    report(tmp_path, "--mesh", "none")
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "Sample clouds" not in headings(text)
    assert {"Before and after", "All records"} <= set(headings(text))
    assert "72.4 ± 0.8" in text  # the paper's, beside the line that it belongs to
    assert "(n=1)" in text


def damaged(grid, folder, damage):
    """A copy of the grid with something in it that cannot be read; where that lies."""
    shutil.copytree(grid, folder)
    bad = folder / "first" / "records" / "extra.json"
    whole = next((folder / "first" / "records").iterdir()).read_text("utf-8")
    if damage == "truncated":
        bad.write_text(whole[:200])
    elif damage == "foreign":
        bad.write_text(json.dumps({**json.loads(whole), "stranger": 1}))
    elif damage == "matrix":
        record = json.loads(whole)
        record["scores"]["confusion"][0] = record["scores"]["confusion"][0][:3]
        bad.write_text(json.dumps(record))
    else:
        bad = folder / "third"
        bad.mkdir()
        shutil.copy(folder / "first" / "settings.json", bad)
    return bad


@pytest.mark.parametrize("damage", ["truncated", "foreign", "matrix", "unfinished"])
def test_what_cannot_be_read_is_named_and_the_rest_is_found(grid, tmp_path, damage):
    bad = damaged(grid, tmp_path / "grid", damage)
    contents = look(tmp_path / "grid")
    assert len(contents.faults) == 1
    assert str(bad) in contents.faults[0]
    assert len(contents.runs) == len(contents.records) == 2


def test_what_is_left_out_is_told_and_the_rest_is_on_the_page(capsys, grid, tmp_path):
    folder = tmp_path / "grid"
    bad = damaged(grid, folder, "truncated")
    report(folder, "--mesh", "none", "--clouds", 0, code=1)
    told = capsys.readouterr().err.splitlines()
    refused = [line for line in told if line.startswith("qs3: left out: ")]
    assert len(refused) == 1
    assert str(bad) in refused[0]
    text = (folder / "report.html").read_text("utf-8")
    assert "1 run or record could not be used" in text
    assert text.count("(n=1)") >= 4  # two lines of two scores


def test_refusals_are_one_line_and_leave_no_page(qs3, capsys, grid, tmp_path):
    assert "no such folder" in qs3.refuses("report", tmp_path / "none")
    (tmp_path / "empty").mkdir()
    assert "neither a finished run nor a record" in refusal(capsys, tmp_path / "empty")
    unfinished = tmp_path / "unfinished"
    shutil.copytree(grid / "first", unfinished)
    (unfinished / "model.safetensors").unlink()
    assert "not finished" in refusal(capsys, unfinished)
    other = tmp_path / "other" / "spoon"
    other.mkdir(parents=True)
    (other / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    line = refusal(capsys, grid / "first", "--data", other.parent, "--mesh", "none")
    assert "spoon" in line
    line = refusal(capsys, grid, "--data", tmp_path / "gone", "--mesh", "none")
    assert "gone" in line
    for flag, value in (("--cloud", "clean"), ("--source-split", "test")):
        line = refusal(capsys, grid, flag, value)
        assert f"{flag} goes with --" in line
    assert "--out" in refusal(capsys, grid, "--out", tmp_path / "empty")
    assert not list(tmp_path.rglob("*.html"))
    assert not (grid / "report.html").exists()


def test_data_that_changed_since_are_not_taken_for_those_of_the_record(grid, tmp_path):
    folder = tmp_path / "grid"
    shutil.copytree(grid, folder)
    shutil.rmtree(folder / "shapes")
    (folder / "shapes" / "chair").mkdir(parents=True)
    (folder / "shapes" / "chair" / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    report(folder, "--mesh", "none")
    text = (folder / "report.html").read_text("utf-8")
    assert "not at hand: --data shows them" in text
    assert "Sample clouds" not in headings(text)
    assert "Before and after" in headings(text)  # from the records


def recorded(grid, folder, cloud):
    """The second run alone, as if it had been trained and scored on another cloud."""
    shutil.copytree(grid / "second", folder)
    told = json.loads((folder / "run.json").read_text("utf-8"))
    told["data"]["source"]["cloud"] = "surface"
    (folder / "run.json").write_text(json.dumps(told))
    for path in (folder / "records").iterdir():
        record = json.loads(path.read_text("utf-8"))
        record["test"]["cloud"] = cloud
        path.write_text(json.dumps(record))
    return look(folder)


def test_data_are_read_as_the_run_and_its_record_read_them(grid, tmp_path):
    """A score on other clouds than the record's would pass for the record's."""
    from qs3.cli.report_page import _clouds
    from qs3.io import load_clouds
    from qs3.training import load_model

    contents = recorded(grid, tmp_path / "run", "clean")
    run, record = contents.runs[0], contents.records[0].record
    loaded, data = load_model(run.folder), str(grid / "shapes")
    sums = {
        kind: load_clouds(data, num_points=64, cloud=kind).checksum
        for kind in ("points", "clean", "surface")
    }
    assert len(set(sums.values())) == 3

    def told(known, **given):
        options = ReportOptions(run.folder, data=data, source=data, **given)
        source, target, test = _clouds(run, options, loaded, known)
        assert test is not None
        assert target.checksum == test.checksum == sums[test.cloud]
        return {sums[kind]: kind for kind in sums}[source.checksum], test.cloud

    assert told(record) == ("surface", "clean")
    assert told(None) == ("surface", "points")  # the run's own target
    assert told(record, cloud="points", source_cloud="clean") == ("clean", "points")


def test_data_without_twins_are_read_whatever_the_record_says(tmp_path):
    """Real scans have one cloud, and are what a network trained on clean twins is tested on."""
    from qs3.cli.report_data import read_data
    from qs3.evaluation.records import DataRecord

    (tmp_path / "scans" / "chair").mkdir(parents=True)
    (tmp_path / "scans" / "chair" / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    known = DataRecord("shapes", "0", 1, None, "clean")
    _, read = read_data(str(tmp_path / "scans"), None, None, known, 3, ("chair",))
    assert read.cloud == "points"


def test_page_names_the_cloud_it_was_scored_on(grid, tmp_path):
    recorded(grid, tmp_path / "run", "clean")
    report(tmp_path / "run", "--data", grid / "shapes", "--mesh", "none", "--clouds", 0)
    text = (tmp_path / "run" / "report.html").read_text("utf-8")
    assert "Scored on 10 clouds of shapes (clean)." in text
    assert ">shapes (clean)</td>" in text
    assert "labelled clouds of shapes (surface)" in text


def test_the_command_on_the_page_has_every_option_that_was_given():
    given = ReportOptions(
        Path("/home/me/runs"), "my scans", "test", "clean", "s3://key@host/set", "train",
        "surface", Path("runs/a"), Path("../b"), "none", "my.toml", 20, Path("/me/page.html"),
    )  # fmt: skip
    assert command_of(given) == (
        "qs3 report runs --data 'my scans' --split test --cloud clean --source set "
        "--source-split train --source-cloud surface --run runs/a --before ../b --mesh none "
        "--sensor my.toml --clouds 20"
    )
    assert command_of(ReportOptions(Path("runs"))) == "qs3 report runs"
