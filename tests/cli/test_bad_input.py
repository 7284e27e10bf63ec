"""Each fault of a user is one clear line, exit code 2, and nothing half-written."""

import numpy as np
import pytest

TETRAHEDRON = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
BAD_MESHES = {
    "missing.off": None,
    "empty.off": "OFF\n0 0 0\n",
    "garbage.off": "this is a text about furniture\nand not a mesh\n",
    "nan.off": "OFF\n3 1 0\n0 0 0\n1 nan 0\n0 1 0\n3 0 1 2\n",
    "zero.off": "OFF\n3 1 0\n1 1 1\n1 1 1\n1 1 1\n3 0 1 2\n",
    "points.ply": (
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n1 1 1\n"
    ),
    "mesh.docx": "x",
}


@pytest.mark.parametrize("name", BAD_MESHES)
def test_bad_mesh_is_named_and_leaves_nothing(qs3, quick, tmp_path, name):
    path = tmp_path / name
    if BAD_MESHES[name] is not None:
        path.write_text(BAD_MESHES[name])
    line = qs3.refuses("scan", path, "--out", tmp_path / "out", *quick)
    assert name in line
    assert not (tmp_path / "out").exists()


def test_unknown_class_lists_the_classes(qs3, quick, tmp_path):
    line = qs3.refuses("scan", "toaster", "--out", tmp_path / "out", *quick)
    assert "toaster" in line
    assert "bathtub" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("scan", "chair", "--sensor", "kinect"), "kinect"),
        (("scan", "chair", "--seed", "-1"), "seed"),
        (("scan", "chair", "--samples", "0"), "samples"),
        (("scan", "chair", "--views", "0"), "views"),
        (("scan", "chair", "--image-noise", "-2"), "noise"),
        (("scan", "chair", "--image-noise", "nan"), "noise"),
        (("scan", "chair", "--views", "300"), "views"),
        (("generate", "--meshes", "shapes", "--pattern", "absent.png"), "absent.png"),
        (("scan", "chair", "--pattern", "absent.png"), "absent.png"),
        (("generate", "--meshes", "absent-folder"), "absent-folder"),
        (("generate", "--meshes", "shapes", "--scans-per-mesh", "0"), "scans_per_mesh"),
        (("train", "--source", "absent-data"), "absent-data"),
        (("train", "--source", "absent-data", "--epochs", "0"), "epochs"),
        (("train", "--source", "absent-data", "--learning-rate", "inf"), "learning_rate"),
        (("train", "--source", "x", "--method", "qbst"), "target"),
        (("train", "--source", "x", "--self-training", "spst"), "target"),
    ],
)
def test_bad_settings_are_one_line(qs3, tmp_path, arguments, word):
    variant = ("--variant", "scalar_rgb") if arguments[0] in ("scan", "generate") else ()
    line = qs3.refuses(*arguments, "--out", tmp_path / "out", *variant)
    assert word in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("scan", "chair", "--viwes", "3"),
        ("scan", "chair", "--view-layout", "ring"),
        ("train", "--source", "x", "--preset", "papr"),
        ("train", "--source", "x", "--self-training.thresold", "0.9"),
        ("scann", "chair"),
    ],
)
def test_unknown_settings_are_errors(qs3, tmp_path, arguments):
    done = qs3(*arguments, "--out", tmp_path / "out", code=2)
    assert arguments[-2].lstrip("-") in done.stderr or arguments[-1] in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_else_is_left_alone(qs3, quick, tmp_path):
    out = tmp_path / "thesis"
    out.mkdir()
    (out / "chapter.txt").write_text("precious")
    for arguments in (("scan", "chair", *quick), ("generate", "--meshes", "shapes", *quick)):
        assert "thesis" in qs3.refuses(*arguments, "--out", out)
    assert [p.name for p in out.iterdir()] == ["chapter.txt"]
    file = tmp_path / "file"
    file.write_text("x")
    assert "file" in qs3.refuses("scan", "chair", *quick, "--out", file)


def test_runs_and_their_data_are_checked(qs3, run, store, tmp_path):
    assert "no-run" in qs3.refuses("evaluate", tmp_path / "no-run", "--data", store)
    assert "absent" in qs3.refuses("evaluate", run, "--data", tmp_path / "absent")
    (tmp_path / "bad.npy").write_bytes(b"no array")
    assert "bad.npy" in qs3.refuses("predict", run, tmp_path / "bad.npy")
    np.save(tmp_path / "nan.npy", np.full((10, 3), np.nan))
    assert "nan.npy" in qs3.refuses("predict", run, tmp_path / "nan.npy")
    # A pickled array would run code; it is refused unread.
    np.save(tmp_path / "pickle.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    assert "pickle.npy" in qs3.refuses("predict", run, tmp_path / "pickle.npy")


def test_other_settings_do_not_overwrite_a_run_or_a_data_set(qs3, quick, run, store):
    before = {p: p.read_bytes() for p in sorted(store.iterdir())}
    line = qs3.refuses("generate", "--meshes", "shapes", "--per-class", 1, "--out", store,
                       "--seed", 6, "--num-points", 128, *quick)  # fmt: skip
    assert "seed" in line
    assert {p: p.read_bytes() for p in sorted(store.iterdir())} == before
    line = qs3.refuses("train", "--source", store, "--out", run, "--model", "pointnet",
                       "--num-points", 64, "--epochs", 3, "--batch-size", 5,
                       "--threads", 1)  # fmt: skip
    assert "epochs" in line


def test_a_network_that_is_not_there_leaves_no_run_behind(qs3, store, tmp_path):
    out = tmp_path / "run"
    assert "foo" in qs3.refuses("train", "--source", store, "--out", out, "--model", "foo")
    assert not out.exists()


def test_predict_needs_files(qs3, run):
    assert "files" in qs3.refuses("predict", run)


def test_an_output_below_a_file_is_one_line(qs3, quick, tmp_path):
    (tmp_path / "file").write_text("x")
    assert "file" in qs3.refuses("scan", "chair", *quick, "--out", tmp_path / "file" / "out")


def test_a_flat_folder_of_meshes_is_told_what_it_lacks(qs3, quick, tmp_path):
    (tmp_path / "cad").mkdir()
    (tmp_path / "cad" / "a.off").write_text(TETRAHEDRON)
    line = qs3.refuses("generate", "--meshes", tmp_path / "cad", "--out", tmp_path / "o", *quick)
    assert "folder a class" in line
    assert not (tmp_path / "o").exists()


def test_classes_of_ones_own_are_taken(qs3, quick, tmp_path):
    for name in ("bolt", "nut"):
        (tmp_path / "cad" / name).mkdir(parents=True)
        (tmp_path / "cad" / name / "a.off").write_text(TETRAHEDRON)
    out = tmp_path / "out"
    qs3("generate", "--meshes", tmp_path / "cad", "--out", out, "--num-points", 64, *quick)
    from qs3.io import load_clouds

    assert load_clouds(out, num_points=64).class_names == ("bolt", "nut")


def test_a_failed_object_is_logged_and_the_others_are_written(qs3, quick, tmp_path):
    for name in ("bed", "chair"):
        (tmp_path / "cad" / name).mkdir(parents=True)
    (tmp_path / "cad" / "bed" / "good.off").write_text(TETRAHEDRON)
    (tmp_path / "cad" / "chair" / "bad.off").write_text("nonsense")
    line = qs3(
        "generate", "--meshes", tmp_path / "cad", "--out", tmp_path / "out", *quick, code=2
    ).stderr.splitlines()[-1]
    assert "failures.jsonl" in line
    assert "chair/bad" in line
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(next((tmp_path / "out").glob("*.parquet")))
    assert table["class_name"].to_pylist() == ["bed"]
