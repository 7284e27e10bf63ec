"""``qs3 demo`` and training that goes on from a network without its source."""

import json

import numpy as np
import pytest
import torch

from qs3.cli.demo import DemoSettings, _adapt, _read_target, _rounds
from qs3.io.clouds import PointClouds
from qs3.training import TrainSettings, fit, load_model, read_run

SIZE = ("--share", 1.0, "--rounds", 1, "--round-epochs", 1, "--workers", 1)


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


@pytest.mark.slow
def test_a_demo_of_the_smallest_size(qs3, run, tmp_path):
    # Ten clouds are too few for a round, which the exit code says; the page is made all the same.
    size = ("--network", run, "--per-class", 1, "--samples", 1, "--sensor", "kinect-v1",
            "--variant", "scalar_rgb", "--source-per-class", 1, "--surfaces-per-class", 1,
            *SIZE)  # fmt: skip
    out = tmp_path / "demo"
    done = qs3("demo", "--out", out, *size, code=4)
    assert str(out / "report.html") in done.stdout
    told = [line.partition("target, ")[2] for line in done.stdout.splitlines()]
    told = [line.partition(":")[0] for line in told if line]
    assert told == ["surfaces alone", f"{run} as it comes", f"{run} after QBST"]
    assert done.stdout.count("95 % interval") == 3
    assert "10 clouds, whose labels served this score alone" in done.stdout
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "qbst" in page
    assert "learnt here from surfaces alone, seen by no camera: 1 shapes a class" in page
    again = qs3("demo", "--out", out, *size, code=4)
    assert again.stdout == done.stdout
    (out / "report.html").unlink()
    alone = qs3("demo", "--out", out, *size, "--surfaces-per-class", 0, code=4)
    assert "surfaces alone" not in alone.stdout
    assert "accuracy on the target" in alone.stdout


def test_a_demo_on_ones_own_scans_tells_answers_and_no_score(qs3, scans, tmp_path):
    out = tmp_path / "demo"
    done = qs3("demo", "--out", out, "--scans", scans, "--source-per-class", 0, *SIZE)
    rows = [line.split() for line in done.stdout.splitlines()[1:11]]
    assert [sum(int(row[place]) for row in rows) for place in (1, 2)] == [40, 40]
    assert "accuracy" not in done.stdout
    table = (out / "predictions.csv").read_text("utf-8").splitlines()
    assert len(table) == 41
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "scans, by predicted class" in page
    assert "Labels of the target" not in page
    assert not list((out / "before").glob("records/*"))
    size = ("--source-per-class", 0, *SIZE, "--share", 0.01)
    none = qs3("demo", "--out", tmp_path / "none", "--scans", scans, *size, code=4)
    assert "raise --share" in none.stderr
    assert "report.html" in none.stdout


@pytest.mark.filterwarnings("ignore::qs3.adaptation.selection.SingleClassWarning")
def test_poisoned_labels_do_not_reach_the_demos_network(run, tmp_path):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, 64, 3)) * rng.uniform(0.2, 2, size=(40, 1, 3))
    states, settings = [], DemoSettings(share=1.0, rounds=2, source_per_class=0)
    for case, shift in {"true": 0, "wrong": 1}.items():
        folder = tmp_path / case
        folder.mkdir()
        labels = (np.arange(40) + shift) % 10
        names = np.array(load_model(run).class_names)
        np.savez(folder / "target.npz", points=points, label=labels, class_names=names)
        clouds = _read_target(folder / "target.npz", run)
        _adapt(clouds, _rounds(settings), run, settings, folder)
        states.append(load_model(folder / "qbst").model.state_dict())
    first, second = states
    assert all(torch.equal(first[name], second[name]) for name in first)
    before = load_model(run).model.state_dict()
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


def test_what_the_demo_cannot_do_is_told_before_a_scan_is_made(qs3, scans, tmp_path):
    out, bad = tmp_path / "demo", tmp_path / "bad"
    assert "threshold_share" in qs3.refuses("demo", "--out", out, "--scans", scans, "--share", 0)
    bad.mkdir()
    np.save(bad / "broken.npy", np.full((40, 3), np.nan))
    assert "broken.npy" in qs3.refuses("demo", "--out", out, "--scans", bad)
    points = np.random.default_rng(2).normal(size=(8, 40, 3)).astype(np.float32)
    ids = tuple(map(str, range(8)))
    screws = PointClouds(points, np.arange(8) % 2, ("bolt", "nut"), ids)
    small = TrainSettings(model="pointnet", num_points=32, epochs=1, batch_size=4, threads=1)
    fit("source-only", screws, None, small, run_dir=tmp_path / "own")
    told = qs3.refuses("demo", "--out", out, "--network", tmp_path / "own")
    assert "does not know all classes of the shapes" in told
    assert not out.exists()


def test_a_folder_with_the_networks_name_is_not_taken_for_it(qs3, scans, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rooms").mkdir()
    assert "rooms: not a run of qs3" in qs3.refuses("demo", "--out", "demo", "--scans", scans)
    assert not (tmp_path / "demo").exists()
