"""``qs3 demo`` and training that goes on from a network without its source."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import qs3 as package
from qs3.cli import demo as module
from qs3.meshes import POINTDA10
from qs3.training import load_model, read_run

from ..stores import write_store

ROUNDS = {"threshold_share": 1.0, "rounds": 1, "epochs": 1}


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """Forty boxes and sticks, as files without labels."""
    folder = tmp_path_factory.mktemp("mine") / "scans"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for row in range(40):
        points = rng.uniform(size=(80 + row, 3)) * rng.uniform(0.2, 2, size=3)
        np.save(folder / f"{row:02d}.npy", points.astype(np.float32))
    return folder


@pytest.fixture
def small(monkeypatch):
    """The smallest demo."""
    for name, value in {"SAMPLES": 1, "TARGET": 2, "SOURCE": 1, "SURFACES": 1, "EPOCHS": 1}.items():
        monkeypatch.setattr(module, f"_{name}", value)
    monkeypatch.setattr(module, "_ROUNDS", ROUNDS | {"source_loss": True})


def write_source(folder, *_, **__):
    if not folder.exists():
        write_store(folder, POINTDA10, [(row % 10, "train", 64) for row in range(40)])


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_demo_of_the_smallest_size(typed, tmp_path):
    out = tmp_path / "demo"
    first = typed("demo", "--out", out, "--workers", 1)
    assert first.stdout.count("accuracy on the target") == 3
    assert f"report: {out / 'report.html'}" in first.stdout
    assert "From mesh to cloud" in (out / "report.html").read_text(encoding="utf-8")
    assert typed("demo", "--out", out, "--workers", 1).stdout == first.stdout


@pytest.mark.usefixtures("small")
def test_three_networks_are_scored_and_a_second_run_prints_the_same(typed, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_scan", write_source)
    monkeypatch.setattr("qs3.cli.report.with_scan", lambda page, *_: page)
    first = typed("demo", "--out", tmp_path / "demo")
    lines = [line for line in first.stdout.splitlines() if line.startswith("accuracy")]
    names = [line.split(", ")[1].partition(":")[0] for line in lines]
    assert names == ["surfaces only", "rooms", "QBST"]
    assert all("95 % interval" in line for line in lines)
    page = (tmp_path / "demo" / "report.html").read_text(encoding="utf-8")
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "Rounds of self-training" in page
    assert typed("demo", "--out", tmp_path / "demo").stdout == first.stdout


@pytest.mark.usefixtures("small")
def test_own_scans_get_answers_and_no_score(typed, scans, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_scan", write_source)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rooms").mkdir()  # a folder with the network's name is not taken for it
    out = tmp_path / "demo"
    done = typed("demo", "--out", out, "--scans", scans)
    rows = [line.split() for line in done.stdout.splitlines()[1:11]]
    assert [sum(int(row[place]) for row in rows) for place in (1, 2)] == [40, 40]
    assert "accuracy" not in done.stdout
    assert len((out / "predictions.csv").read_text("utf-8").splitlines()) == 41
    assert (out / "report.html").is_file()
    assert not list((out / "before").glob("records/*"))


@pytest.mark.filterwarnings("ignore::qs3.adaptation.selection.SingleClassWarning")
def test_poisoned_labels_do_not_reach_the_adapted_network(tmp_path):
    write_source(tmp_path / "source")
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, 64, 3)) * rng.uniform(0.2, 2, size=(40, 1, 3))
    states = []
    for case, shift in {"true": 0, "wrong": 1}.items():
        path = tmp_path / f"{case}.npz"
        labels = (np.arange(40) + shift) % 10
        np.savez(path, points=points, label=labels, class_names=np.array(POINTDA10))
        package.adapt(tmp_path / "source", path, tmp_path / case, warm_up="rooms",
                      self_training=ROUNDS)  # fmt: skip
        states.append(load_model(tmp_path / case / "run").model.state_dict())
    first, second = states
    assert all(torch.equal(first[name], second[name]) for name in first)
    before = load_model(Path("rooms")).model.state_dict()
    assert not all(torch.equal(first[name], before[name]) for name in first)


def test_self_training_goes_on_from_a_network_without_its_source(qs3, scans, run, tmp_path):
    words = ("train", "--method", "qbst", "--target", scans, "--warm-up", run,
             "--self-training.threshold-share", 1.0, "--self-training.rounds", 1,
             "--self-training.epochs", 1)  # fmt: skip
    out = tmp_path / "run"
    qs3(*words, "--out", out)
    settings = json.loads((out / "settings.json").read_text())
    made, before = read_run(out), read_run(run)
    assert settings["train"]["model"] == "pointnet"
    assert settings["train"]["num_points"] == 64
    assert settings["self_training"]["source_loss"] is False
    assert made.source == before.source
    assert set(made.source_clouds) == set(before.source_clouds)
    assert not made.rounds[0]["skipped"]
    line = qs3.refuses(*words, "--self-training.source-loss", "--out", tmp_path / "other")
    assert "source_loss needs labelled clouds" in line
    assert not (tmp_path / "other").exists()
    code = qs3("train", "--method", "qbst", "--target", scans, "--out", out, code=2)
    assert "--source" in code.stderr


def test_unreadable_scans_are_refused_before_a_scan_is_made(qs3, tmp_path):
    out, bad = tmp_path / "demo", tmp_path / "bad"
    bad.mkdir()
    np.save(bad / "broken.npy", np.full((40, 3), np.nan))
    assert "broken.npy" in qs3.refuses("demo", "--out", out, "--scans", bad)
    assert "no such folder" in qs3.refuses("demo", "--out", out, "--scans", tmp_path / "none")
    assert "must not be negative" in qs3.refuses("demo", "--out", out, "--seed", "-1")
    assert not out.exists()
