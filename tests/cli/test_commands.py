"""Every verb, as the README has it, on the smallest input that means something."""

import json
import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from packaging.requirements import Requirement

from qs3.cli import VERBS, doctor
from qs3.files import LOCK, folder_lock
from qs3.sensor.stage.settings import ScanSettings

ROOT = Path(__file__).parents[2]


def test_help_and_version_import_no_verb():
    code = "import sys, qs3.cli; qs3.cli.run(sys.argv[1:]); print(sorted(sys.modules))"
    for option in ("--help", "--version"):
        done = subprocess.run([sys.executable, "-c", code, option], capture_output=True, text=True)
        for module in ("tyro", "numpy", "torch", "qs3.cli.scan", "qs3.errors"):
            assert f"'{module}'" not in done.stdout
    assert f"qs3 {version('qs3')}\n" in done.stdout


def test_every_verb_explains_itself(typed):
    text = typed("--help").stdout
    assert re.findall(r"^  (\w+)  ", text, re.M) == list(VERBS)
    for verb in VERBS:
        help_text = " ".join(typed(verb, "--help").stdout.split())
        assert f"usage: qs3 {verb}" in help_text
        for strange in ("(default: None)", "PATH PATH", "``"):
            assert strange not in help_text, verb


def test_a_verb_that_is_not_there_offers_the_nearest(typed):
    assert "did you mean scan" in typed.refuses("scann", "chair")
    assert "usage: qs3" in typed(code=2).stderr


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        ([], {}),
        (["--preset", "paper", "--size", "box"], {"preset": "paper", "size": "box"}),
        (["--preset", "released"], {"preset": "released"}),
        (
            ["--sensor", "d435", "--matching", "opencv-bm", "--material", "dark", "--crop", "mask",
             "--randomise", "light.ambient=0:0.1", "material=dark,metal", "--object-size", "0.5"],
            {"sensor": "d435", "matching": "opencv-bm", "material": "dark", "crop": "mask",
             "randomise": ["light.ambient=0:0.1", "material=dark,metal"], "object_size": 0.5},
        ),
    ],
)  # fmt: skip
def test_options_mean_what_the_settings_mean_in_python(typed, monkeypatch, words, changes):
    taken = []

    def scan(_, settings, **__):
        taken.append(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr("qs3.sensor.scan.scan", scan)
    typed("scan", "chair", "--out", "x", "--variant", "scalar_rgb", *words, code=130)
    settings = ScanSettings(variant="scalar_rgb", **changes)
    assert taken[0].as_dict() == settings.as_dict()
    assert taken[0].make_sensor() == settings.make_sensor()
    released = taken[0].make_sensor().depth.principal_point == "released"
    assert released == (changes.get("preset") == "released")


def test_scan_writes_what_it_says(typed, small, tmp_path):
    out = tmp_path / "chair"
    done = typed("scan", "chair", "--out", out, "--seed", 2, *small)
    names = {"cloud.ply", "clean.ply", "montage.png", "scan.json"}
    assert {p.name for p in out.iterdir()} == {*names, LOCK}
    assert set(done.stdout.split()) == {str(out / name) for name in names}
    record = json.loads((out / "scan.json").read_text())
    assert record["seed"] == 2
    assert record["settings"]["views"] == 1
    assert record["sensor"]["rig"]["focal"] == 375.0
    assert record["renderer"]["variant"] == "scalar_rgb"
    for key in ("valid_fraction", "disparity_bias", "disparity_sigma", "gross_share"):
        assert isinstance(record["views"][0][key], float)
    assert {"render", "matching", "sampling"} <= record["seconds"].keys()
    cloud = trimesh.load(out / "cloud.ply")
    assert cloud.vertices.shape == (2048, 3)
    assert np.abs(cloud.vertices).max() <= 0.75
    montage = cv2.imread(str(out / "montage.png"))
    assert min(montage.shape[:2]) > 600
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with folder_lock(out):
        assert "another qs3 is writing" in typed.refuses("scan", "table", "--out", out, *small)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_train_evaluate_predict(typed, run, store, tmp_path):
    done = typed("evaluate", run, "--data", store, "--json")
    record = json.loads(done.stdout)
    assert record["method"] == "source-only"
    assert record["selection"] == "last"
    assert record["scores"]["clouds"] == 10
    assert record["marks"] == ["training clouds"]
    assert record["source"]["checksum"] == record["test"]["checksum"]
    assert sum(map(sum, record["scores"]["confusion"])) == 10
    rng = np.random.default_rng(0)
    np.save(tmp_path / "a.npy", rng.standard_normal((500, 3)))
    np.savetxt(tmp_path / "b.xyz", rng.standard_normal((20, 3)))
    done = typed("predict", run, tmp_path / "a.npy", tmp_path / "b.xyz", "--json", "-")
    rows = json.loads(done.stdout)
    assert [row["file"] for row in rows] == [str(tmp_path / n) for n in ("a.npy", "b.xyz")]
    hostile = tmp_path / "a\x85\u202eb.npy"
    (tmp_path / "a.npy").rename(hostile)
    done = typed("predict", run, hostile, "--json", "-")
    assert done.stdout.isascii()
    assert json.loads(done.stdout)[0]["file"] == str(hostile)
    for row in rows:
        assert sum(row["probabilities"].values()) == pytest.approx(1.0)
        assert row["confidence"] == max(row["probabilities"].values())


@pytest.mark.slow
def test_doctor_imports_what_it_reports_and_tells_a_missing_library(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests" / "hidden"), prepend=os.pathsep)
    monkeypatch.setenv("QS3_HIDDEN", "pyrealsense2")
    # A process of its own: Python reads both when it starts.
    command = [sys.executable, "-m", "qs3", "doctor"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.endswith("Ready.\n")
    _, *parts = re.split(r"\n\w+:\n", done.stdout)
    packages, renderers, extras = (dict(re.findall(r"  (.+?): (.+)\n", part)) for part in parts)
    assert renderers["scalar_rgb"] == "ok"
    assert {"numpy", "torch", "mitsuba"} <= packages.keys()
    assert all(state.startswith("ok ") for state in packages.values())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert extras.keys() == project["optional-dependencies"].keys() - {"cycles", "dev", "docs"}
    fault = "pyrealsense2 cannot be loaded: libusb-1.0.so.0; apt-get install libusb-1.0-0"
    assert extras["realsense"] == fault


def test_doctor_tells_a_missing_package_and_one_that_does_not_fit():
    needed = Requirement("no-such-package>=1")
    assert doctor._state(needed).startswith("no-such-package is not installed; pip install")
    assert "does not fit" in doctor._state(Requirement("numpy>=99"))


@pytest.mark.parametrize("has_llvm", [True, False])
def test_doctor_prints_what_renders_without_llvm_and_that_scans_are_slower(
    monkeypatch, capsys, has_llvm
):
    monkeypatch.setattr(doctor, "_state", lambda need: "ok 1")
    working = {"scalar_rgb", *(["llvm_ad_mono"] if has_llvm else [])}
    monkeypatch.setattr("qs3.sensor.light.mitsuba.usable", working.__contains__)
    assert doctor.doctor() == 0
    printed = capsys.readouterr().out
    (line,) = (line for line in printed.splitlines() if "llvm_ad_mono" in line)
    assert line == "  llvm_ad_mono: ok" or not has_llvm
    for words in ("scalar_rgb renders in its place", "same noise but slower", "qs3[llvm]"):
        assert (words in line) != has_llvm
    assert printed.endswith("Ready.\n")


@pytest.mark.parametrize("ready", [True, False])
def test_doctor_prints_what_is_missing_and_whether_it_can_scan(monkeypatch, capsys, ready):
    lost = "ray is not installed"
    monkeypatch.setattr(doctor, "_state", lambda need: lost if need.name == "ray" else "ok 1")
    monkeypatch.setattr("qs3.sensor.light.mitsuba.usable", lambda variant: ready)
    assert doctor.doctor() == (0 if ready else 1)
    printed = capsys.readouterr().out
    assert f"\n  ray: {lost}\n" in printed
    assert "\n  numpy: ok 1\n" in printed
    assert ("\nReady.\n" in printed) == ready


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("sensors", "show", "~/absent.toml"), "absent.toml"),
        (("generate", "--dry-run", "--meshes=~/absent"), "absent"),
        (("generate", "--dry-run", "--meshes", "shapes", "--map=~/absent.toml"), "absent.toml"),
    ],
)
def test_the_home_folder_is_known_where_a_shell_leaves_it(
    typed, monkeypatch, tmp_path, words, named
):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert f"{tmp_path / named}: " in typed.refuses(*words)


def test_records_are_appended_to_no_other_file(typed, tmp_path):
    (tmp_path / "mine.jsonl").write_text('{"image": 1}\n')
    words = ("evaluate", tmp_path / "no run", "--data", tmp_path / "no data")
    line = typed.refuses(*words, "--records", tmp_path / "mine.jsonl")
    assert "mine.jsonl: is there already and holds no records" in line
