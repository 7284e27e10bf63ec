import numpy as np
import pytest
import trimesh

from qs3.clouds.files import read_cloud
from qs3.clouds.layouts.folders import read_folder, write_folder
from qs3.clouds.load import load_unlabelled
from qs3.clouds.ply_writer import ply_bytes
from qs3.clouds.types import RaggedClouds
from qs3.errors import InputError

from ..hostile import refused
from .common import content, hard_floats, make_clouds


def unlabelled(clouds, splits=()):
    ids = tuple(f"scene/{i}" for i in range(len(clouds)))
    return RaggedClouds(clouds=clouds, ids=ids, checksum="", splits=splits)


@pytest.mark.parametrize("splits", [("train", "test"), ("",), ("", "test")])
def test_what_is_written_reads_back_equal(rng, tmp_path, splits):
    clouds = make_clouds(rng, ("Night Stand", "Stühle 1", "bed"), 50, 3, splits)
    write_folder(tmp_path / "set", clouds)
    back = read_folder(tmp_path / "set")
    assert content(back) == content(clouds)
    assert back.class_names == ("Night Stand", "Stühle 1", "bed")
    if "test" in splits:
        test = read_folder(tmp_path / "set", "test")
        assert set(test.splits) == {"test"}
        assert len(test.ids) == 9


def test_a_ply_reads_equal_by_trimesh(rng, tmp_path):
    points = hard_floats(rng, 500)
    path = tmp_path / "a.ply"
    path.write_bytes(ply_bytes(points))
    # Bits, so that the sign of zero counts.
    independent = np.asarray(trimesh.load(path, process=False).vertices).astype(np.float32)
    np.testing.assert_array_equal(independent.view(np.uint32), points.view(np.uint32))
    np.testing.assert_array_equal(read_cloud(path).view(np.uint32), points.view(np.uint32))


def test_clouds_without_labels_keep_their_splits(rng, tmp_path):
    clouds = [rng.random((5, 3)).astype(np.float32) for _ in range(3)]
    write_folder(tmp_path / "flat", unlabelled(clouds))
    assert sorted(path.name for path in (tmp_path / "flat").iterdir())[0] == "scene_0.ply"
    write_folder(tmp_path / "parts", unlabelled(clouds, ("train", "train", "test")))
    back = read_folder(tmp_path / "parts")
    assert back.labels is None
    assert sorted(back.splits) == ["test", "train", "train"]
    assert load_unlabelled(tmp_path / "parts", split="test", num_points=5).points.shape[0] == 1
    with pytest.raises(InputError, match="a split and others none"):
        write_folder(tmp_path / "no", unlabelled(clouds, ("train", "", "test")))
    assert not (tmp_path / "no").exists()


def _saved(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        np.save(root / name, np.random.default_rng(len(name)).random((4, 3)))
    return root


@pytest.mark.parametrize(
    "names",
    [
        ("bed/Train/a.npy", "bed/TEST/b.npy", "bed/valid/c.npy"),
        ("Train/bed/a.npy", "Test/bed/b.npy", "validation/bed/c.npy"),
        ("training/a.npy", "testing/b.npy", "val/c.npy"),
    ],
)
def test_splits_are_known_in_capitals_and_by_their_other_names(tmp_path, names):
    clouds = read_folder(_saved(tmp_path, *names))
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "notes.md").touch()
    assert read_folder(tmp_path).checksum == clouds.checksum
    if names[0] == "Train/bed/a.npy":
        with refused(r"beside them \(stray\.npy\)"):
            read_folder(_saved(tmp_path, "Train/stray.npy"))
        (tmp_path / "Train" / "stray.npy").unlink()
    assert sorted(clouds.splits) == ["test", "train", "val"]
    assert clouds.class_names == (("bed",) if "bed" in names[0] else ())
    assert len(read_folder(tmp_path, "val").ids) == 1
    write_folder(tmp_path / "copy", clouds)
    assert sorted(read_folder(tmp_path / "copy").splits) == ["test", "train", "val"]


@pytest.mark.parametrize("name", ["bed/dev/b.npy", "bed/train/x/b.npy", "bed/a/b/c/d.npy"])
def test_clouds_that_lie_too_deep_are_named(tmp_path, name):
    with refused("lies too deep: .* called train, test or val", tmp_path / name):
        read_folder(_saved(tmp_path, "bed/train/a.npy", name))
    with refused("lies too deep", tmp_path / "train" / name):
        read_folder(_saved(tmp_path / "train", name).parent)


@pytest.mark.parametrize(
    "names",
    [
        ("-1.npy", "B.npy", "a.npy", "b.npy", "c.npy", "d.npy", "e.npy"),
        ("Zed/x.npy", "bed/y.npy", "bed/train/z.npy", "bed/test/a.npy", "sofa/test/a.npy"),
        ("test/bed/z.npy", "test/sofa/a.npy", "train/bed/a.npy"),
    ],
)
def test_clouds_come_by_class_split_and_name(tmp_path, names):
    assert read_folder(_saved(tmp_path, *names[::-1])).ids == names


def test_clouds_of_other_endings_are_counted(tmp_path, caplog):
    for name in ("bed/b.pts", "bed/train/c.csv", "bed/objects.csv", "bed/notes.md"):
        (_saved(tmp_path, "bed/train/a.npy") / name).touch()
    assert len(read_folder(tmp_path).ids) == 1
    assert caplog.messages == [f"{tmp_path}: not read: 1 .csv, 1 .pts; save clouds as .ply"]


def test_a_class_that_is_named_train_is_a_class(rng, tmp_path):
    for part in ("train", "test"):
        (tmp_path / "train" / part).mkdir(parents=True)
        np.save(tmp_path / "train" / part / "a.npy", rng.random((4, 3)))
    assert read_folder(tmp_path).class_names == ("train",)
    assert len(read_folder(tmp_path, "test").ids) == 1


def test_a_class_folder_has_one_name_in_both_forms_of_unicode(tmp_path):
    for folder in ("St\u00fchle", "Stu\u0308hle", "bed"):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "a.npy", np.eye(3))
    read = read_folder(tmp_path)
    assert read.class_names == ("St\u00fchle", "bed")
    assert sorted(read.labels.tolist()) == [0, 0, 1]


def test_hostile_ids_stay_in_the_folder(rng, tmp_path):
    ids = ("../../evil", "/etc/passwd", "a\0b", "..", ".", "", "x" * 5000, "x" * 4999 + "y", "A",
           "a", "C:\\x", ".hidden", "bed/train/../../../up", "a.npy", "\ud800")  # fmt: skip
    clouds = [np.full((2, 3), i, dtype=np.float32) for i in range(len(ids))]
    labels = np.zeros(len(ids), dtype=np.int64)
    ragged = RaggedClouds(clouds, ids, "", labels, ("bed",), ("train",) * len(ids))
    root = tmp_path / "inner" / "set"
    write_folder(root, ragged)
    assert [path.name for path in tmp_path.iterdir()] == ["inner"]
    assert [path.name for path in (tmp_path / "inner").iterdir()] == ["set"]
    names = [path.name.casefold() for path in (root / "bed" / "train").iterdir()]
    assert len(set(names)) == len(ids)
    back = read_folder(root)
    assert sorted(float(cloud[0, 0]) for cloud in back.clouds) == list(range(len(ids)))


@pytest.mark.parametrize(
    "name", ["", ".", "..", "a/b", "..\\b", ".git", "a\0", "train", "x" * 300, "con:", "a.", " a"]
)
def test_a_class_that_cannot_name_a_folder_is_refused(tmp_path, name):
    clouds = RaggedClouds([np.zeros((2, 3))], ("a",), "", np.array([0]), (name,))
    with pytest.raises(InputError, match="cannot name a folder"):
        write_folder(tmp_path / "set", clouds)
    assert not (tmp_path / "set").exists()


def test_classes_and_splits_that_no_folder_tells_apart_are_refused(tmp_path):
    pair = [np.zeros((2, 3))] * 2
    clouds = RaggedClouds(pair, ("a", "b"), "", np.array([0, 1]), ("Bed", "bed"))
    with pytest.raises(InputError, match="differ in capitals only"):
        write_folder(tmp_path / "set", clouds)
    clouds = RaggedClouds(pair, ("a", "b"), "", np.array([0, 0]), ("bed",), ("train", "dev"))
    with pytest.raises(InputError, match="split 'dev' has no folder"):
        write_folder(tmp_path / "set", clouds)
