"""``qs3 report`` on a run, on several, on records; and what it refuses."""

import json
import re
import shutil

import pytest


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


def test_same_input_gives_the_same_bytes_and_no_path_of_this_machine(qs3, grid, page, tmp_path):
    again = tmp_path / "again.html"
    qs3("report", grid, "--mesh", "none", "--out", again)
    assert again.read_text("utf-8") == page
    assert [p.name for p in tmp_path.iterdir()] == ["again.html"]
    assert str(grid) not in page


def test_page_of_one_run_lands_in_its_folder_with_the_scan_step_by_step(qs3, grid, tmp_path):
    folder = tmp_path / "plain"
    shutil.copytree(grid / "first", folder)
    done = qs3("report", folder, "--data", grid / "shapes")
    assert done.stdout == f"{folder / 'report.html'}\n"
    text = (folder / "report.html").read_text("utf-8")
    assert headings(text)[:2] == ["From mesh to cloud", "Sample clouds"]
    assert "What it takes for what" in text  # one network: no before and after
    assert 'id="verdict"' not in text
    assert "Training clouds: the network learnt from labels of clouds" in text


def test_records_alone_make_tables_and_no_clouds(qs3, grid, tmp_path):
    for name in ("first", "second"):
        for record in (grid / name / "records").iterdir():
            shutil.copy(record, tmp_path / f"S-D_{name}_seed-0.json")
    shutil.move(tmp_path / "S-D_second_seed-0.json", tmp_path / "S-D_qbst_seed-0.json")
    qs3("report", tmp_path, "--mesh", "none")
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "Sample clouds" not in headings(text)
    assert {"Before and after", "All records"} <= set(headings(text))
    assert "72.4 ± 0.8" in text  # the paper's, beside the line that it belongs to
    assert "(n=1)" in text


@pytest.mark.parametrize("damage", ["truncated", "foreign", "matrix", "unfinished"])
def test_what_cannot_be_read_is_named_and_the_rest_is_on_the_page(qs3, grid, tmp_path, damage):
    folder = tmp_path / "grid"
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
    done = qs3("report", folder, "--mesh", "none", "--clouds", 0, code=1)
    refused = [line for line in done.stderr.splitlines() if line.startswith("qs3: left out: ")]
    assert len(refused) == 1
    assert str(bad) in refused[0]
    text = (folder / "report.html").read_text("utf-8")
    assert "1 run or record could not be used" in text
    assert text.count("(n=1)") >= 4  # two lines of two scores


def test_refusals_are_one_line_and_leave_no_page(qs3, grid, store, tmp_path):
    assert "no such folder" in qs3.refuses("report", tmp_path / "none")
    (tmp_path / "empty").mkdir()
    assert "neither a finished run nor a record" in qs3.refuses("report", tmp_path / "empty")
    unfinished = tmp_path / "unfinished"
    shutil.copytree(grid / "first", unfinished)
    (unfinished / "model.safetensors").unlink()
    assert "not finished" in qs3.refuses("report", unfinished)
    other = tmp_path / "other" / "spoon"
    other.mkdir(parents=True)
    (other / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    line = qs3.refuses("report", grid / "first", "--data", other.parent, "--mesh", "none")
    assert "spoon" in line
    line = qs3.refuses("report", grid, "--data", tmp_path / "gone", "--mesh", "none")
    assert "gone" in line
    assert "--out" in qs3.refuses("report", grid, "--out", tmp_path / "empty")
    assert not list(tmp_path.rglob("*.html"))
    assert not (grid / "report.html").exists()


def test_data_that_changed_since_are_not_taken_for_those_of_the_record(qs3, grid, tmp_path):
    folder = tmp_path / "grid"
    shutil.copytree(grid, folder)
    shutil.rmtree(folder / "shapes")
    (folder / "shapes" / "chair").mkdir(parents=True)
    (folder / "shapes" / "chair" / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    qs3("report", folder, "--mesh", "none")
    text = (folder / "report.html").read_text("utf-8")
    assert "not at hand: --data shows them" in text
    assert "Sample clouds" not in headings(text)
    assert "Before and after" in headings(text)  # from the records
