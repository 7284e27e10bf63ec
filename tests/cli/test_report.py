"""``qs3 report`` as a user calls it."""

import re
from pathlib import Path

import numpy as np
import pytest

from qs3.report.scans import Tile, write_sheets


def test_the_page_of_a_run_has_every_part(typed, store, run, tmp_path, quick):
    typed("evaluate", run, "--data", store)
    out = tmp_path / "page.html"
    done = typed("report", run, "--data", store, "--source", store, "--out", out)
    assert done.stdout == f"{out}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    page = out.read_text("utf-8")
    assert re.findall(r"<h2>(.*?)</h2>", page) == [
        "Clouds",
        "Training",
        "Confusion matrix",
        "Settings, data and versions",
    ]
    assert re.findall(r'<div class="score">([\w-]+)<b>', page) == ["source-only"]
    assert len(re.findall(r'<i data-class="\d+"', page)) == 20
    assert str(run.parent) not in page


def test_refusals_are_one_line_and_leave_no_page(typed, run, tmp_path):
    assert "none" in typed.refuses("report", tmp_path / "none")
    assert "--out" in typed.refuses("report", run, "--out", tmp_path)
    assert "--split goes with --data" in typed.refuses("report", run, "--split", "test")
    assert "--clouds -1" in typed.refuses("report", run, "--clouds", -1)
    assert "nowhere: no such file" in typed.refuses("report", run, "--scans", tmp_path / "nowhere")
    assert not list(tmp_path.rglob("*.html"))
    assert not (run / "report.html").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("report", "RUN", "--out", "page.html"), "page.html: is there already and is no page of"),
        (
            ("report", "RUN", "--scans", "scans", "--out", "new.html"),
            "parts.html: is there already",
        ),
        (
            ("report", "RUN", "--scans", "scans", "--out", "./parts.html"),
            "is the page of the parts",
        ),
        (("report", "RUN", "--out", "x.png"), "--out x.png: name a .html file"),
        (("suggest", "RUN", "scans", "--out", "labels.csv"), "labels.png: is no such picture"),
        (("suggest", "RUN", "scans", "--out", "x.png"), "--out x.png: name a .csv file"),
        (
            ("evaluate", "RUN", "--data", "scans", "--records", "h.jsonl"),
            "h.jsonl: is there already and holds no records",
        ),
        (("predict", "RUN", "scans", "--pictures", "poses"), "--pictures poses: shows CAD, and"),
    ],
)
def test_what_others_wrote_stays(typed, run, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    for folder in ("scans/a", "poses"):
        (tmp_path / folder).mkdir(parents=True)
    np.save("scans/a/one.npy", np.random.default_rng(0).random((100, 3)))
    write_sheets(Path("poses/poses.png"), [Tile(np.eye(3), "")])
    for name in ("page.html", "labels.png", "h.jsonl", *["parts.html"] * ("new.html" in words)):
        Path(name).write_text('{"kind": "epoch"}\n')
    held = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    assert message in typed.refuses(*(run if word == "RUN" else word for word in words))
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == held


def test_a_page_replaces_a_page(typed, run, tmp_path):
    for _ in range(2):
        typed("report", run, "--out", tmp_path / "page.html")
