"""``qs3 demo`` on samples in place of simulated scans, and self-training without a source."""

import csv
import json

import numpy as np
import pytest
from PIL import Image

from qs3.cli import demo as module
from qs3.runs import read_run

from ..stores import generate_quickly


@pytest.fixture
def smallest(monkeypatch):
    """The smallest demo."""
    monkeypatch.setattr(module, "_SCANS", 4)
    monkeypatch.setattr(module, "_LABELS", 1)
    monkeypatch.setattr("qs3.parts.forest.TREES", 40)
    monkeypatch.setattr("qs3.parts.cad.JUDGED", 16)
    monkeypatch.setattr("qs3.workflow.adapt.generate", generate_quickly)
    monkeypatch.setattr("qs3.store.generate.generate", generate_quickly)


def test_a_stop_while_labels_are_filled_in_loses_no_row(tmp_path, monkeypatch):
    labels, text = tmp_path / "labels.csv", "file,class\nscans/rod/a.ply,\nscans/nut/b.ply,\n"
    labels.write_text(text)
    with monkeypatch.context() as patch:
        patch.setattr(csv.DictWriter, "writeheader", lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            module._fill_in(labels)
    assert labels.read_text() == text
    assert module._fill_in(labels) == {"scans/rod/a.ply", "scans/nut/b.ply"}
    assert labels.read_text() == "file,class\nscans/rod/a.ply,rod\nscans/nut/b.ply,nut\n"


@pytest.mark.slow
@pytest.mark.usefixtures("smallest")
def test_five_ways_are_scored_and_a_second_run_prints_the_same(typed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = typed("demo")
    title, head, *rows = [line for line in first.stdout.splitlines() if line][-11:-4]
    assert "no real camera took part" in title
    assert head.split()[:4] == ["answered", "by", "of", "all"]
    assert [row.split("  ")[0] for row in rows] == [
        "forest of surfaces", "CAD alone, rendered and compared", "forest of simulated scans",
        "forest and CAD", "forest, CAD and 8 labels",
    ]  # fmt: skip
    assert all("of 24" in row for row in rows)  # 8 parts, 4 scans, without the 8 labelled ones
    verbs = [line.split()[1] for line in first.stderr.splitlines() if line.startswith("qs3 ")]
    assert verbs[:3] == ["generate", "convert", "adapt"]
    assert {"locate", "suggest", "train", "predict", "report"} <= {*verbs}
    assert "it is simulated too" in first.stderr
    assert "all is done in about" in first.stderr
    assert (tmp_path / "demo" / "report.html").is_file()
    assert (tmp_path / "demo" / "mine" / "parts.html").is_file()
    with Image.open(tmp_path / "demo" / "poses" / "poses.png") as picture:
        picture.verify()
    labels = list(
        csv.DictReader((tmp_path / "demo" / "labels.csv").read_text("utf-8").splitlines())
    )
    assert all(f"/{row['class']}/" in row["file"] for row in labels)
    assert read_run(tmp_path / "demo" / "few").method == "few-label"
    assert "\tresidual" not in first.stdout  # no line per scan
    assert typed("demo").stdout.splitlines()[-11:] == first.stdout.splitlines()[-11:]
    before = (tmp_path / "demo" / "demo.json").read_bytes()
    assert "made with another seed" in typed.refuses("demo", "--seed", 1)
    assert (tmp_path / "demo" / "demo.json").read_bytes() == before


@pytest.mark.filterwarnings("ignore::qs3.adaptation.SingleClassWarning")
def test_self_training_goes_on_from_a_network_without_its_source(typed, run, tmp_path):
    scans = tmp_path / "scans"
    scans.mkdir()
    rng = np.random.default_rng(0)
    for row in range(40):
        points = rng.uniform(size=(80 + row, 3)) * rng.uniform(0.2, 2, size=3)
        np.save(scans / f"{row:02d}.npy", points.astype(np.float32))
    words = ("train", "--method", "qbst", "--target", scans, "--warm-up", run,
             "--self-training.threshold-share", 1.0, "--self-training.rounds", 1,
             "--self-training.epochs", 1)  # fmt: skip
    out = tmp_path / "run"
    typed(*words, "--out", out)
    settings = json.loads((out / "settings.json").read_text())
    after, before = read_run(out), read_run(run)
    assert settings["train"]["model"] == "pointnet"
    assert settings["train"]["num_points"] == 64
    assert settings["self_training"]["source_loss"] is False
    assert after.source == before.source
    assert set(after.source_clouds) == set(before.source_clouds)
    line = typed.refuses(*words, "--self-training.source-loss", "--out", tmp_path / "other")
    assert "source_loss needs labelled clouds" in line
    assert not (tmp_path / "other").exists()
    code = typed("train", "--method", "qbst", "--target", scans, "--out", out, code=2)
    assert "--source" in code.stderr
