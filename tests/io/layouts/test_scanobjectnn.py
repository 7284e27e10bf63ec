import dataclasses

import h5py
import numpy as np
import pytest

from qs3.errors import InputError
from qs3.io.layouts.scanobjectnn import CLASSES, FORMAT, read_scanobjectnn, write_scanobjectnn
from qs3.io.load import detect, load_clouds
from qs3.meshes.classes import POINTDA10

from .common import content, make_clouds


def release(folder, rng, variant="", labels=range(15)):
    """One variant as it is released: data, label and a mask whose −1 is background."""
    folder.mkdir(parents=True, exist_ok=True)
    labels = np.array(labels)
    stored = {}
    for part in ("training", "test"):
        data = rng.normal(size=(len(labels), 32, 3)).astype(np.float32)
        with h5py.File(folder / f"{part}_objectdataset{variant}.h5", "w") as file:
            file["data"], file["label"] = data, labels
            file["mask"] = rng.choice([-1, 5], size=data.shape[:2])
        stored[part] = data
    return stored


def turned(data):
    return np.stack([data[..., 0], -data[..., 2], data[..., 1]], axis=-1)


def test_the_release_is_read_whole_background_too(tmp_path, rng):
    stored = release(tmp_path / "main_split", rng)
    for path in (tmp_path, tmp_path / "main_split"):
        assert detect(path) is FORMAT
        clouds = read_scanobjectnn(path)
        assert clouds.splits == ("train",) * 15 + ("test",) * 15
        expected = turned(np.concatenate([stored["training"], stored["test"]]))
        np.testing.assert_array_equal(clouds.clouds, expected)
        assert clouds.labels.tolist() == [*range(15)] * 2
        assert len(set(clouds.ids)) == 30
        np.testing.assert_array_equal(read_scanobjectnn(path, "test").clouds, expected[15:])
    names = "bag bin box cabinet chair desk display door shelf table bed pillow sink sofa toilet"
    assert clouds.class_names == tuple(names.split())
    rows = load_clouds(tmp_path, split="train", num_points=None, class_names=CLASSES)
    np.testing.assert_array_equal(rows.points, expected[:15])


def test_one_file_is_read_alone(tmp_path, rng):
    release(tmp_path, rng)
    stored = release(tmp_path, rng, "_augmentedrot_scale75")
    path = tmp_path / "test_objectdataset_augmentedrot_scale75.h5"
    assert detect(path) is FORMAT
    clouds = read_scanobjectnn(path)
    np.testing.assert_array_equal(clouds.clouds, turned(stored["test"]))
    assert set(clouds.splits) == {"test"}
    with pytest.raises(InputError, match="no split 'train', only test"):
        read_scanobjectnn(path, "train")
    message = r"several variants \(objectdataset\.h5, objectdataset_augmentedrot_scale75\.h5\)"
    with pytest.raises(InputError, match=message):
        read_scanobjectnn(tmp_path)


def test_background_or_not_is_asked(tmp_path, rng):
    for name in ("main_split", "main_split_nobg"):
        release(tmp_path / name, rng)
    with pytest.raises(InputError, match=r"name .*main_split or .*main_split_nobg"):
        read_scanobjectnn(tmp_path)


def test_convention_the_files_are_y_up_and_are_turned_z_up(tmp_path):
    # A chair, y up, seen from +z: seat at 0.5, back up to 1 on the far side, an armrest to the
    # right (+x), of 1 metre height.
    seat = np.c_[np.linspace(-0.2, 0.2, 6), np.full(6, 0.5), np.linspace(-0.1, 0.2, 6)]
    back = np.c_[np.zeros(6), np.linspace(0.6, 1, 6), np.full(6, -0.25)]
    rest = np.c_[np.full(4, 0.3), np.full(4, 0.7), np.linspace(-0.1, 0.1, 4)]
    chair = np.concatenate([seat, back, rest])[None].astype(np.float32)
    with h5py.File(tmp_path / "test_objectdataset.h5", "w") as file:
        file["data"], file["label"] = chair, [CLASSES.index("chair")]
    cloud = read_scanobjectnn(tmp_path).clouds[0]
    assert cloud[6:12, 2].min() > cloud[:6, 2].max()  # the back is above the seat
    np.testing.assert_array_equal(cloud[6:12, 1], np.full(6, 0.25, np.float32))  # and far: +y
    assert (cloud[12:, 0] > 0.2).all()
    write_scanobjectnn(tmp_path / "b", read_scanobjectnn(tmp_path))
    with h5py.File(tmp_path / "b" / "test_objectdataset.h5") as file:
        np.testing.assert_array_equal(file["data"][:], chair)


def test_what_is_written_is_read_by_the_published_description(tmp_path, rng):
    given = make_clouds(rng, (*CLASSES[1:], CLASSES[0]), num_points=16, per_part=2)
    write_scanobjectnn(tmp_path / "a", given)
    rows = []
    for part, name in (("train", "training"), ("test", "test")):
        with h5py.File(tmp_path / "a" / f"{name}_objectdataset.h5", "r") as file:
            data, label = file["data"][:], file["label"][:]
        assert data.dtype == np.float32
        assert data.shape == (30, 16, 3)
        assert label.shape == (30,)
        for cloud, row in zip(turned(data), label, strict=True):
            rows.append((CLASSES[row], part, np.ascontiguousarray(cloud).tobytes()))
    assert sorted(rows) == content(given)


def test_aliases_map_and_other_classes_are_named(tmp_path, rng):
    given = make_clouds(rng, ("night_stand", "monitor", "bookshelf"), num_points=4)
    write_scanobjectnn(tmp_path / "a", given)
    back = read_scanobjectnn(tmp_path / "a")
    assert sorted({CLASSES[i] for i in back.labels}) == ["cabinet", "display", "shelf"]
    with pytest.raises(InputError, match="class 'bathtub', 'lamp', 'plant' is none of: bag, bin"):
        write_scanobjectnn(tmp_path / "b", make_clouds(rng, POINTDA10, num_points=4))
    assert not (tmp_path / "b").exists()


def test_one_split_gives_one_file_and_sizes_become_one(tmp_path, rng):
    given = make_clouds(rng, ("bed", "sofa"), splits=("test",), num_points=4)
    ragged = [rng.random((count, 3)).astype(np.float32) for count in (3, 2050)]
    write_scanobjectnn(tmp_path / "a", dataclasses.replace(given, clouds=ragged))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["test_objectdataset.h5"]
    assert [len(c) for c in read_scanobjectnn(tmp_path / "a").clouds] == [2048, 2048]


def test_other_paths_are_refused(tmp_path):
    (tmp_path / "my.h5").touch()
    with pytest.raises(InputError, match=r"my\.h5: is not called training_objectdataset"):
        read_scanobjectnn(tmp_path / "my.h5")
    with pytest.raises(InputError, match=r"holds no training_objectdataset\*\.h5"):
        read_scanobjectnn(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_scanobjectnn(tmp_path / "test_objectdataset.h5")
    (tmp_path / "test_objectdataset.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(InputError, match=r"test_objectdataset\.h5: cannot be read as HDF5"):
        read_scanobjectnn(tmp_path)
