"""Every verb, as the README has it, on the smallest input that means something."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh


def test_scan_writes_what_it_says(qs3, quick, tmp_path):
    out = tmp_path / "chair"
    done = qs3("scan", "chair", "--out", out, "--seed", 2, "--save-images", *quick)
    names = {p.name for p in out.iterdir()}
    pictures = {f"view-0-{n}" for n in ("left.png", "right.png", "depth.png", "true-depth.png")}
    assert names == {"cloud.ply", "clean.ply", "montage.png", "scan.json", "view-0-camera.json"} | (
        pictures
    )
    assert set(done.stdout.split()) == {str(out / name) for name in names}
    record = json.loads((out / "scan.json").read_text())
    assert record["seed"] == 2
    assert record["settings"]["views"] == 1
    assert record["sensor"]["rig"]["focal"] == 1500.0
    assert record["renderer"]["variant"] == "scalar_rgb"
    for key in ("valid_fraction", "disparity_bias", "disparity_sigma", "gross_share"):
        assert isinstance(record["views"][0][key], float)
    assert {"render", "matching", "sampling"} <= record["seconds"].keys()
    cloud = trimesh.load(out / "cloud.ply")
    assert cloud.vertices.shape == (2048, 3)
    assert np.abs(cloud.vertices).max() <= 0.75
    # The 16-bit depth, lifted with the camera file, is the true depth's neighbour.
    camera = json.loads((out / "view-0-camera.json").read_text())
    depth = cv2.imread(str(out / "view-0-depth.png"), cv2.IMREAD_UNCHANGED)
    true = cv2.imread(str(out / "view-0-true-depth.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    both = (depth > 0) & (true > 0)
    error = (depth[both].astype(float) - true[both]) * camera["depth_unit"]
    assert np.abs(np.median(error)) < 0.02
    montage = cv2.imread(str(out / "montage.png"))
    assert min(montage.shape[:2]) > 600


def test_scan_again_gives_the_same_bytes(qs3, quick, tmp_path):
    for name in ("a", "b"):
        qs3("scan", "table", "--out", tmp_path / name, "--seed", 9, *quick)
    for file in ("cloud.ply", "clean.ply", "montage.png"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_presets_set_their_columns_and_a_setting_beside_them_wins(qs3, tmp_path):
    common = ("--variant", "scalar_rgb", "--samples", "1", "--views", "1")
    qs3("scan", "sofa", "--out", tmp_path / "r", "--preset", "released", *common)
    record = json.loads((tmp_path / "r" / "scan.json").read_text())
    assert record["settings"]["view_layout"] == "jitter"
    assert record["settings"]["box_crop"] is True
    assert record["sensor"]["depth"]["principal_point"] == "released"
    qs3("scan", "sofa", "--out", tmp_path / "p", "--preset", "paper", "--size", "box", *common)
    record = json.loads((tmp_path / "p" / "scan.json").read_text())
    assert record["settings"]["size"] == "box"
    assert record["settings"]["box_crop"] is False


def test_generate_is_byte_identical_with_two_workers(qs3, quick, store, tmp_path):
    out = tmp_path / "again"
    qs3("generate", "--meshes", "shapes", "--per-class", 1, "--out", out, "--seed", 5,
        "--num-points", 128, "--workers", 2, *quick)  # fmt: skip
    ours, theirs = ({p.name: p.read_bytes() for p in f.iterdir()} for f in (out, store))
    assert ours == theirs
    assert any(name.endswith(".parquet") for name in ours)


def test_generate_again_does_nothing(qs3, quick, store):
    before = {p.name: p.stat().st_mtime_ns for p in store.glob("*.parquet")}
    done = qs3("generate", "--meshes", "shapes", "--per-class", 1, "--out", store, "--seed", 5,
               "--num-points", 128, *quick)  # fmt: skip
    assert "0 scans written, 10 were there before" in done.stderr
    assert {p.name: p.stat().st_mtime_ns for p in store.glob("*.parquet")} == before


def test_store_holds_noisy_clean_and_surface_clouds_that_overlay(store):
    from qs3.io import load_clouds

    clouds = [load_clouds(store, num_points=128, cloud=c) for c in ("points", "clean", "surface")]
    assert [len(c) for c in clouds] == [10, 10, 10]
    assert clouds[0].labels.tolist() == list(range(10))
    # All lie in the normalised mesh's box; the noisy cloud in the box of the turned mesh, whose
    # corners are at most at a radius of 1.
    assert np.abs(clouds[1].points).max() <= 0.5 + 1e-5
    assert np.abs(clouds[2].points).max() <= 0.5 + 1e-5
    radius = np.linalg.norm(clouds[0].points[:, :, :2], axis=2)
    assert 0.3 < radius.max() <= 1 + 1e-5
    assert np.abs(clouds[0].points[:, :, 2]).max() <= 0.5 + 1e-5


def test_train_evaluate_predict(qs3, run, store, tmp_path):
    done = qs3("evaluate", run, "--data", store, "--json")
    record = json.loads(done.stdout)
    assert record["method"] == "source-only"
    assert record["selection"] == "last"
    assert record["scores"]["clouds"] == 10
    assert record["marks"] == ["training clouds"]
    assert record["source"]["checksum"] == record["test"]["checksum"]
    assert sum(map(sum, record["scores"]["confusion"])) == 10
    text = qs3("evaluate", run, "--data", store).stdout
    assert f"{record['scores']['accuracy']:.1%}" in text
    assert "class-mean" in text

    rng = np.random.default_rng(0)
    np.save(tmp_path / "a.npy", rng.standard_normal((500, 3)))
    np.savetxt(tmp_path / "b.xyz", rng.standard_normal((20, 3)))
    done = qs3("predict", run, tmp_path / "a.npy", tmp_path / "b.xyz", "--json")
    found = json.loads(done.stdout)
    assert [row["file"] for row in found] == [str(tmp_path / n) for n in ("a.npy", "b.xyz")]
    for row in found:
        assert sum(row["probabilities"].values()) == pytest.approx(1.0)
        assert row["confidence"] == max(row["probabilities"].values())
    lines = qs3("predict", run, tmp_path / "a.npy").stdout.splitlines()
    assert lines[0].split("\t")[1] == found[0]["class"]


def test_qbst_with_each_preset(qs3, run, store, tmp_path):
    for preset in ("default", "paper", "released"):
        out = tmp_path / preset
        qs3("train", "--source", store, "--target", store, "--method", "qbst", "--warm-up", run,
            "--preset", preset, "--self-training.rounds", 2, "--self-training.epochs", 1,
            "--self-training.threshold", 0.1, "--model", "pointnet", "--num-points", 64,
            "--epochs", 2, "--batch-size", 5, "--threads", 1, "--out", out)  # fmt: skip
        record = json.loads(qs3("evaluate", out, "--data", store, "--json").stdout)
        assert record["settings"]["preset"] == preset
        assert [r["theta"] for r in record["rounds"]] == [0.1, pytest.approx(0.105)]
        assert "transductive" in record["marks"]
        expected = "least-confident" if preset == "released" else "most-confident"
        assert record["settings"]["self_training"]["selection"] == expected


def test_doctor_tells_what_is_here(qs3):
    found = json.loads(qs3("doctor", "--json-output").stdout)
    assert found["ready"] is True
    assert found["renderers"]["scalar_rgb"] is True
    text = qs3("doctor").stdout
    assert "Ready." in text
    for extra, here in found["extras"].items():
        assert here or f".[{extra}]" in text


VERBS = (
    *("scan", "sensors", "realism", "generate", "merge", "info", "verify", "convert", "extract"),
    *("train", "evaluate", "predict", "doctor", "demo"),
)


def test_every_verb_explains_itself(qs3):
    text = qs3("--help").stdout
    for verb in VERBS:
        assert verb in text
        assert "usage: qs3" in qs3(verb, "--help").stdout


def test_a_demo_of_the_smallest_size(qs3, tmp_path):
    out = tmp_path / "demo"
    size = ("--source-per-class", 2, "--target-per-class", 2,
            "--source-views", 1, "--samples", 1,
            "--variant", "scalar_rgb", "--model", "pointnet",
            "--num-points", 64, "--epochs", 3, "--rounds", 2,
            "--round-epochs", 1, "--workers", 1)  # fmt: skip
    done = qs3("demo", "--out", out, *size)
    assert str(out / "report.html") in done.stdout
    assert done.stdout.count("accuracy on the target") == 2
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "source-only" in page
    assert "qbst" in page
    again = qs3("demo", "--out", out, *size)
    assert again.stdout == done.stdout


ROOT = Path(__file__).parents[2]
