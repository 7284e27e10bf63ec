"""``qs3 report`` as a user calls it."""

import re
import shutil
from pathlib import Path

import pytest

import qs3.cli.report as cli
from qs3.cli.report import command_of
from qs3.report.settings import ReportSettings


@pytest.fixture(scope="module")
def grid(qs3, store, run, tmp_path_factory):
    """A folder with a source-only run, one that it warmed up, their data and their records."""
    folder = tmp_path_factory.mktemp("grid")
    shutil.copytree(store, folder / "shapes")
    shutil.copytree(run, folder / "first")
    qs3("train", "--source", store, "--target", store, "--method", "qbst", "--warm-up", run,
        "--out", folder / "second", "--model", "pointnet", "--num-points", 64, "--epochs", 2,
        "--batch-size", 5, "--threads", 1, "--preset", "default", "--self-training.threshold", 0.0,
        "--self-training.rounds", 2, "--self-training.epochs", 1,
        code=4)  # fmt: skip  # ten clouds are too few for a round
    for name in ("first", "second"):
        qs3("evaluate", folder / name, "--data", folder / "shapes")
    return folder


def test_page_of_several_runs_has_every_part(qs3, grid, tmp_path):
    done = qs3("report", grid, "--out", tmp_path / "page.html")
    assert done.stdout == f"{tmp_path / 'page.html'}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    page = (tmp_path / "page.html").read_text("utf-8")
    assert re.findall(r"<h2>(.*?)</h2>", page) == [
        "From mesh to cloud",
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
    assert len(re.findall(r'<i data-class="\d+"', page)) > 20  # twenty by class, and the pairs
    tabs = re.findall(r'role="tab" [^>]*>(.*?)</button>', page)
    assert tabs[0] == "By class"
    assert tabs[-1] == "Beside the nearest source scan"
    assert re.search(r'data-note="Taken for \w+ \(source-only\), \w+ \(qbst\)"', page)
    assert str(grid) not in page


def test_what_is_left_out_is_told_and_the_rest_is_on_the_page(capsys, grid, tmp_path):
    shutil.copytree(grid, tmp_path / "grid")
    bad = tmp_path / "grid" / "first" / "records" / "extra.json"
    bad.write_text("{")
    assert cli.report(tmp_path / "grid", ReportSettings(clouds=0), mesh="none") == 1
    printed = capsys.readouterr()
    assert printed.out == f"{tmp_path / 'grid' / 'report.html'}\n"
    assert f"qs3: left out: {bad}" in printed.err
    assert (tmp_path / "grid" / "report.html").is_file()


def test_refusals_are_one_line_and_leave_no_page(qs3, grid, tmp_path):
    assert "no such folder" in qs3.refuses("report", tmp_path / "none")
    assert "--out" in qs3.refuses("report", grid, "--out", tmp_path)
    assert "--cloud goes with --data" in qs3.refuses("report", grid, "--cloud", "clean")
    assert not list(tmp_path.rglob("*.html"))
    assert not (grid / "report.html").exists()


def test_published_figures_are_text_by_task_and_row():
    tasks, source = cli._published()
    assert tasks["S-D"]["qbst"] == "72.4 ± 0.8"
    assert "ECCV 2022" in source


def test_the_command_on_the_page_has_every_option_that_was_given():
    settings = ReportSettings("my scans", "test", "clean", "s3://key@host/set", "train",
                              "surface", Path("runs/a"), Path("../b"), 20)  # fmt: skip
    assert command_of(Path("/me/runs"), settings, "none", "my.toml") == (
        "qs3 report runs --data 'my scans' --split test --cloud clean --source set "
        "--source-split train --source-cloud surface --run runs/a --before ../b --clouds 20 "
        "--mesh none --sensor my.toml"
    )
    assert command_of(Path("runs"), ReportSettings()) == "qs3 report runs"
