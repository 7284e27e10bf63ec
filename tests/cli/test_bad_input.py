"""Each fault of a user is one clear line, exit code 2, and nothing half-written."""

from pathlib import Path

import numpy as np
import pytest

TETRAHEDRON = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("scan", "toaster"), ("toaster", "bathtub")),
        (("scan", "absent.off"), ("absent.off: no such file",)),
        (("scan", "chair", "--sensor", "kinect"), ("kinect-v1",)),
        (("scan", "chair", "--pattern", "absent.png"), ("absent.png",)),
        (("scan", "chair", "--randomise", "light.ambiant=0:1"), ("light.ambient",)),
        (("scan", "chair", "--sensor", "d435", "--randomise", "rooms", "--scene", "wall"),
         ("room.layout=wall",)),
        (("generate", "--meshes", "absent-folder"), ("absent-folder",)),
        (("generate", "--meshes", "shapes", "--classes", "chair", "--per-class", "1",
          "--scene", "beside"), ("second mesh",)),
    ],
)  # fmt: skip
def test_bad_scans_are_one_line(typed, tmp_path, arguments, words):
    out = ("--out", tmp_path / "out", "--variant", "scalar_rgb")
    line = typed.refuses(*arguments, *out)
    assert all(word in line for word in words)
    assert not (tmp_path / "out").exists()


def test_a_flat_mesh_that_is_to_lie_somehow_is_named(typed, tmp_path):
    (tmp_path / "gasket.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    line = typed.refuses("scan", tmp_path / "gasket.off", "--sensor", "d435", "--pose", "resting",
                         "--variant", "scalar_rgb", "--out", tmp_path / "out")  # fmt: skip
    assert "gasket.off: is flat" in line


CLOSED = Path("/proc/qs3-out")
"""A folder that nobody can make."""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="Linux only")
@pytest.mark.parametrize(
    "arguments",
    [
        ("scan", "chair", "--out"),
        ("generate", "--meshes", "shapes", "--out"),
        ("predict", "run", ".", "--sort-into"),
        ("predict", "run", ".", "--pictures"),
        ("find", "shapes", "cloud.npy", "--pictures"),
        ("segment", "cloud.ply", "--out"),
    ],
)
def test_a_folder_that_cannot_be_written_is_refused_first(typed, tmp_path, monkeypatch, arguments):
    def computed(*_, **__):
        pytest.fail("computed before the folder was tried")

    for name in ("sensor.scan.scan", "answers.answer.answer", "store.generate._Run",
                 "parts.locate_files.library_of"):  # fmt: skip
        monkeypatch.setattr(f"qs3.{name}", computed)
    monkeypatch.chdir(tmp_path)
    np.save("cloud.npy", np.random.default_rng(0).random((900, 3)) / 10)
    line = typed.refuses(*arguments, CLOSED)
    assert str(CLOSED) in line
    assert "name another folder" in line


@pytest.mark.parametrize(
    "arguments",
    [
        ("scan", "chair", "--viwes", "3"),
        ("scan", "chair", "--view-layout", "ring"),
        ("train", "--source", "x", "--preset", "papr"),
        ("train", "--source", "x", "--self-training.thresold", "0.9"),
    ],
)
def test_unknown_settings_are_errors(typed, tmp_path, arguments):
    done = typed(*arguments, "--out", tmp_path / "out", code=2)
    assert arguments[-2].lstrip("-") in done.stderr or arguments[-1] in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_else_is_left_alone(typed, quick, tmp_path):
    out = tmp_path / "thesis"
    out.mkdir()
    (out / "chapter.txt").write_text("precious")
    for arguments in (("scan", "chair", *quick), ("generate", "--meshes", "shapes", *quick)):
        assert "thesis" in typed.refuses(*arguments, "--out", out)
    assert [p.name for p in out.iterdir()] == ["chapter.txt"]
    # An output that is a file, or lies below one.
    file = out / "chapter.txt"
    for place in (file, file / "out"):
        assert "chapter.txt" in typed.refuses("scan", "chair", *quick, "--out", place)


def test_runs_and_their_data_are_checked(typed, run, store, tmp_path):
    assert "no-run" in typed.refuses("evaluate", tmp_path / "no-run", "--data", store)
    assert "absent" in typed.refuses("evaluate", run, "--data", tmp_path / "absent")
    assert "files" in typed.refuses("predict", run)
    np.save(tmp_path / "nan.npy", np.full((10, 3), np.nan))
    # A pickled array would run code; it is refused unread.
    np.save(tmp_path / "pickle.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    for name in ("nan.npy", "pickle.npy"):
        assert name in typed.refuses("predict", run, tmp_path / name)
    assert "qs3 convert" in typed.refuses("predict", run, store, "--sort-into", tmp_path / "new")
    # What is in the way of the answers is told before a cloud is read.
    for option in ("--sort-into", "--csv", "--json"):
        line = typed.refuses("predict", run, tmp_path / "nan.npy", option, store)
        assert str(store) in line and "nan.npy" not in line


def test_other_settings_do_not_overwrite_a_run_or_a_data_set(typed, small, run, store):
    before = {p: p.read_bytes() for p in sorted(store.iterdir())}
    line = typed.refuses("generate", "--meshes", "shapes", "--per-class", 1, "--out", store,
                         "--seed", 6, "--num-points", 128, *small)  # fmt: skip
    assert "seed" in line
    assert {p: p.read_bytes() for p in sorted(store.iterdir())} == before
    line = typed.refuses("train", "--source", store, "--out", run, "--model", "pointnet",
                         "--num-points", 64, "--epochs", 3, "--batch-size", 5,
                         "--threads", 1)  # fmt: skip
    assert "epochs" in line


def test_meshes_of_an_unknown_class_are_refused(typed, quick, tmp_path):
    for name in ("train/a.off", "test/cup/b.off"):
        (tmp_path / "cad" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "cad" / name).write_text(TETRAHEDRON)
    line = typed.refuses("generate", "--meshes", tmp_path / "cad", "--out", tmp_path / "o", *quick)
    assert "folder per class" in line
    assert not (tmp_path / "o").exists()
