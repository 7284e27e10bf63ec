import numpy as np
import pytest

from qs3 import reading
from qs3.clouds.load import describe_clouds, load_clouds, load_unlabelled, read_clouds
from qs3.clouds.types import PointClouds, UnlabelledClouds, digests
from qs3.errors import InputError
from qs3.meshes.classes import POINTDA10

from .hostile import refused


@pytest.fixture
def folder(tmp_path, rng):
    """Two classes under aliases, both splits, clouds of different sizes."""
    names = ("Night Stand", "Night Stand", "desk", "desk")
    for name, part, count in zip(names, ("train", "test") * 2, (20, 30, 40, 64), strict=True):
        place = tmp_path / "set" / name / part
        place.mkdir(parents=True)
        np.save(place / "a.npy", rng.random((count, 3)))
        (place / ".hidden.npy").write_bytes(b"")
        (place / "notes.md").write_text("not a cloud")
    return tmp_path / "set"


def write_npz(path, rng, **changes):
    arrays = {
        "points": rng.random((90, 3)).astype(np.float32),
        "offset": np.array([0, 20, 50, 90]),
        "label": np.array([1, 0, 1], dtype=np.uint8),
        "class_names": np.array(["dresser", "bed"]),
        "is_train": np.array([True, False, True]),
    } | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def test_names_are_kept_as_they_stand_though_all_are_aliases(folder):
    clouds = load_clouds(folder, split="test", num_points=32)
    assert isinstance(clouds, PointClouds)
    assert clouds.points.shape == (2, 32, 3)
    assert clouds.class_names == ("Night Stand", "desk")
    assert clouds.labels.tolist() == [0, 1]
    assert clouds.origin.renamed == {}
    assert clouds.ids == ("Night Stand/test/a.npy", "desk/test/a.npy")
    assert len(load_clouds(folder, num_points=32)) == 4


@pytest.mark.parametrize("names", [("chair", "table"), ("sofa",), ("bed", "chair", "mug")])
def test_classes_that_are_among_the_ten_stay_alone(names, tmp_path, rng):
    for name in names:
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "a.npy", rng.random((40, 3)))
    clouds = load_clouds(tmp_path, num_points=32)
    assert clouds.class_names == names
    assert clouds.labels.tolist() == list(range(len(names)))
    only = load_clouds(tmp_path, num_points=32, class_map={names[0]: "table"})
    assert set(only.class_names) == {"table", *names[1:]}
    assert load_clouds(tmp_path, num_points=32, class_names=(*names, "x")).class_names[-1] == "x"


def test_the_ten_names_are_given_on_request_and_it_is_told(folder, rng):
    ten = load_clouds(folder, num_points=8, class_names=POINTDA10)
    assert ten.class_names == POINTDA10
    assert [POINTDA10[i] for i in ten.labels] == ["cabinet"] * 2 + ["table"] * 2
    assert ten.origin.renamed == {"Night Stand": "cabinet", "desk": "table"}
    assert ten.without_labels().origin.renamed == {}
    (folder / "toilet").mkdir()
    np.save(folder / "toilet" / "a.npy", rng.random((8, 3)))
    with pytest.raises(InputError, match=r"set: class 'toilet' is not one of: bathtub.*--map"):
        load_clouds(folder, num_points=8, class_names=POINTDA10)
    called = {"toilet": "chair", "desk": "lamp"}  # a map comes before the table of aliases
    ten = load_clouds(folder, num_points=8, class_names=POINTDA10, class_map=called)
    assert ten.origin.renamed == {"Night Stand": "cabinet"} | called


def test_a_map_merges_what_it_names_and_keeps_the_rest(folder):
    one = load_clouds(folder, num_points=8, class_map={"desk": "Night Stand", "mug": "cup"})
    assert one.class_names == ("Night Stand",)
    assert one.origin.renamed == {"desk": "Night Stand"}
    two = load_clouds(folder, num_points=8, class_map={"desk": "bench"})
    assert two.class_names == ("Night Stand", "bench")
    with pytest.raises(InputError, match=r"set: the map of classes names mug, and none of Night"):
        load_clouds(folder, num_points=8, class_map={"mug": "cup"})


def test_labels_are_left_behind_and_never_needed(folder, rng, tmp_path):
    bare = load_unlabelled(folder, num_points=16)
    assert isinstance(bare, UnlabelledClouds)
    labelled = load_clouds(folder, num_points=16).points
    assert sorted(digests(bare.points)) == sorted(digests(labelled))
    # The order of the files, which follows the classes, stays behind too.
    (folder / "Night Stand").rename(folder / "zzz")
    np.testing.assert_array_equal(load_unlabelled(folder, num_points=16).points, bare.points)
    flat = tmp_path / "flat"
    flat.mkdir()
    for name in ("b.xyz", "a.xyz"):
        np.savetxt(flat / name, rng.random((9, 3)))
    # Not even names go along: they often tell the class.
    assert load_unlabelled(flat, num_points=9).ids == ("000000", "000001")
    with pytest.raises(InputError, match="has no labels"):
        load_clouds(flat)
    path = write_npz(tmp_path / "a.npz", rng, label=None, class_names=None)
    assert load_unlabelled(path, num_points=8).points.shape == (3, 8, 3)


def test_the_checksum_follows_names_and_bytes(folder):
    before = load_clouds(folder, num_points=8).checksum
    assert load_unlabelled(folder, num_points=16).checksum == before
    assert load_clouds(folder, split="test", num_points=8).checksum != before
    path = folder / "desk" / "test" / "a.npy"
    path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    assert load_clouds(folder, num_points=8).checksum != before


def test_an_archive_of_clouds_of_different_sizes(rng, tmp_path):
    path = write_npz(tmp_path / "a.npz", rng)
    clouds = load_clouds(path, num_points=25)
    assert clouds.points.shape == (3, 25, 3)
    assert [clouds.class_names[i] for i in clouds.labels] == ["bed", "dresser", "bed"]
    assert load_clouds(path, split="test", num_points=8).ids == ("a/00001",)
    with np.load(path) as archive:
        np.testing.assert_array_equal(clouds.points[0][:20], archive["points"][:20])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": None}, "no array called points"),
        ({"points": np.zeros((90, 2))}, r"not float64 of shape \[90, 2\]"),
        ({"points": np.full((90, 3), np.inf)}, "no point that is finite"),
        ({"offset": np.array([0, 20, 20, 90])}, "offset does not cut"),
        ({"offset": None}, r"shape \[90, 3\]; one cloud is saved as points\[None\]"),
        ({"offset": None, "points": np.ones((3, 3, 90))}, "transpose it"),
        ({"label": None, "labels": np.array([0, 1, 0])}, "call it label"),
        ({"label": np.array([0, 1, 2])}, "not one of 0 to 1"),
        ({"label": np.array([0.0, 1.0, 0.0])}, "label must hold whole numbers.* not float64"),
        ({"label": np.array(["bed", "bed", "bed"])}, "label must hold whole numbers.* not <U3"),
        ({"class_names": None}, "needs class_names"),
        ({"class_names": np.array(["bed", None], dtype=object)}, "allow_pickle=False"),
        ({"is_train": np.array([2, 0, 2])}, "is_train must hold True and False .*, not 2"),
        ({"is_train": np.array([1, np.nan, 0])}, "is_train must .* or train and test, not nan"),
        ({"is_train": np.array(["train", "val", "test"])}, "is_train must .*, not 'val'"),
        ({"is_train": np.array([b"train", b"test", b"test"])}, "is_train must .*, not b'test'"),
        ({"is_train": None, "split": np.array(["train", "val", "test"])}, "split, .* is_train"),
        ({"strict": np.array(["no", "no", "no"]), "frame": np.arange(3)}, "strict must .*'no'"),
    ],
)
def test_a_bad_archive_is_named(rng, tmp_path, changes, message):
    path = write_npz(tmp_path / "a.npz", rng, **changes)
    with refused(message, "a.npz"):
        load_clouds(path)


@pytest.mark.parametrize(
    "flags", [[1, 0, 1], [True, False, True], [1.0, 0.0, 1.0], ["train", "test", "train"]]
)
def test_splits_of_an_archive_are_numbers_or_words(rng, tmp_path, flags):
    path = write_npz(tmp_path / "a.npz", rng, is_train=np.array(flags))
    assert load_clouds(path, split="test", num_points=8).ids == ("a/00001",)
    assert read_clouds(path)[0].splits == ("train", "test", "train")


def test_an_archive_that_is_none(rng, tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(b"no archive")
    with pytest.raises(InputError, match="cannot be read as NPZ"):
        load_clouds(path)
    with path.open("wb") as handle:
        np.save(handle, rng.random((2, 8, 3)))
    with pytest.raises(InputError, match="cannot be read as NPZ"):
        load_clouds(path)
    whole = write_npz(tmp_path / "b.npz", rng).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cannot be read as NPZ"):
        load_clouds(path)
    with pytest.raises(InputError, match="no split 'dev'"):
        load_clouds(tmp_path / "b.npz", split="dev")


def test_an_archive_that_would_unpack_beyond_the_ceiling_is_refused(tmp_path, rng, monkeypatch):
    path = write_npz(tmp_path / "a.npz", rng)
    monkeypatch.setattr(reading, "MOST_BYTES", 2 * path.stat().st_size)
    np.savez_compressed(path, points=np.zeros((4, 5000, 3), np.float32))
    with refused(r"a\.npz: its content has \d+ bytes, more than the limit"):
        load_clouds(path)


@pytest.mark.data
def test_the_real_depth_camera_objects(shared_data):
    clouds = load_clouds(shared_data / "sunrgbd_objects.npz", num_points=128, class_names=POINTDA10)
    counts = {name: int((clouds.labels == i).sum()) for i, name in enumerate(clouds.class_names)}
    found = {name: n for name, n in counts.items() if n}
    assert found == {"bed": 10, "cabinet": 9, "chair": 10, "table": 3}


@pytest.mark.data
def test_modelnet10_keeps_its_own_classes(shared_data):
    path = shared_data / "modelnet10_1024.npz"
    test = load_clouds(path, split="test")
    assert test.points.shape == (908, 1024, 3)
    assert "toilet" in test.class_names
    assert test.ids[0].startswith("bathtub_")
    assert len(load_unlabelled(path, split="train")) == 3991


def test_a_data_set_of_any_layout_is_described(folder, rng, tmp_path):
    contents = describe_clouds(folder)
    assert (contents["layout"], contents["rows"], contents["points"]) == ("folder", 4, [20, 64])
    assert contents["classes"] == {"Night Stand": 2, "desk": 2}
    assert contents["splits"] == {"test": 2, "train": 2}
    bare = describe_clouds(write_npz(tmp_path / "a.npz", rng, label=None, class_names=None))
    assert (bare["layout"], bare["classes"]) == ("npz", {})
