import h5py
import numpy as np
import pytest

from qs3 import reading
from qs3.clouds.load import detect
from qs3.errors import InputError
from qs3.geometry import y_up_to_z_up
from qs3.meshes.classes import POINTDA10
from qs3.paper.data.hdf5 import MODELNET40_CLASSES, SCANOBJECTNN_CLASSES, read_hdf5

from ...clouds.hostile import refused
from ...clouds.layouts.common import hard_floats


@pytest.fixture
def arrays(rng):
    """Six clouds of eight points with a colour, of four classes."""
    data = rng.normal(size=(6, 8, 6)).astype(np.float32)
    return {"data": data, "label": np.array([0, 3, 1, 2, 0, 3], dtype=np.int32)}


def save(path, **datasets):
    path.parent.mkdir(exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, array in datasets.items():
            file.create_dataset(name, data=array)
    return path


def turned(data):
    return np.stack([data[..., 0], -data[..., 2], data[..., 1]], axis=-1)


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", "<f2"])
@pytest.mark.parametrize("columns", [3, 6])
def test_floats_of_every_kind_are_read(tmp_path, arrays, kind, columns):
    data = arrays["data"][..., :columns].astype(kind)
    for label in (arrays["label"], arrays["label"].astype(np.uint8)[:, None]):
        clouds = read_hdf5(save(tmp_path / "train_0.h5", data=data, label=label))
        assert clouds.clouds[0].dtype == np.float32
        np.testing.assert_array_equal(clouds.clouds, turned(data[..., :3].astype(np.float32)))
        np.testing.assert_array_equal(clouds.labels, arrays["label"])


@pytest.mark.parametrize(
    ("train", "test", "classes"),
    [
        ("ply_data_train{}.h5", "ply_data_test{}.h5", MODELNET40_CLASSES),
        ("train_{}.h5", "test_{}.h5", POINTDA10),
        ("training_objectdataset.h5", "test_objectdataset.h5", SCANOBJECTNN_CLASSES),
    ],
)
def test_release_of_every_data_set_is_read(tmp_path, arrays, train, test, classes):
    root = tmp_path / "set"
    numbers = (10, 2) if "{}" in train else (0,)
    for number in numbers:
        save(root / train.format(number), **arrays, normal=arrays["data"])
    save(root / test.format(0), **arrays)
    (root / "train_files.txt").write_text("data/elsewhere/ply_data_train0.h5\n")
    if classes != POINTDA10:
        assert detect(root).name == detect(root / test.format(0)).name == "h5"
    clouds = read_hdf5(root)
    assert clouds.class_names == classes
    assert clouds.splits == ("train",) * 6 * len(numbers) + ("test",) * 6
    stems = [f"{train.format(number).removesuffix('.h5')}/00005" for number in sorted(numbers)]
    assert list(clouds.ids[5:-6:6]) == stems
    assert len(read_hdf5(root, "test").ids) == 6
    one = read_hdf5(root / train.format(numbers[0]))
    np.testing.assert_array_equal(one.clouds, turned(arrays["data"]))
    with pytest.raises(InputError, match="no split 'test', only train"):
        read_hdf5(root / train.format(numbers[0]), "test")


def test_several_data_sets_or_variants_in_a_folder_are_refused(tmp_path, arrays):
    save(tmp_path / "training_objectdataset.h5", **arrays)
    save(tmp_path / "test_objectdataset_augmentedrot.h5", **arrays)
    with pytest.raises(InputError, match=r"several data sets or variants .*name one file"):
        read_hdf5(tmp_path)
    assert len(read_hdf5(tmp_path / "training_objectdataset.h5").ids) == 6
    save(tmp_path / "mine.h5", **arrays)
    for path in (tmp_path / "mine.h5", tmp_path / "none"):
        with pytest.raises(InputError, match="no HDF5 file of a known name; expected"):
            read_hdf5(path)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("data", None, "data"),
        ("label", None, "label"),
        ("data", np.ones((6, 8, 2)), r"not float64 of shape \[6, 8, 2\]"),
        ("data", np.ones((6, 8, 3), int), "must be floats"),
        ("data", np.full((6, 8, 3), np.nan), "cloud 0 holds no point that is finite"),
        ("label", np.zeros(5, int), r"whole numbers of shape \[6\]"),
        ("label", np.zeros(6), "must be whole numbers"),
        ("label", np.full(6, 40), "label 40 is out of range 0–39"),
    ],
)
def test_bad_datasets_are_refused_in_one_line(tmp_path, arrays, name, array, message):
    arrays |= {name: array}
    path = tmp_path / "ply_data_train0.h5"
    save(path, **{key: value for key, value in arrays.items() if value is not None})
    with refused(message, f"{path}: "):
        read_hdf5(path)


def _linked(file, other, data):
    file["data"] = h5py.ExternalLink(str(other), "data")


def _linked_within(file, other, data):
    file["far"] = h5py.ExternalLink(str(other), "/")
    file["data"] = h5py.SoftLink("/far/data")


def _virtual(file, other, data):
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    layout[:] = h5py.VirtualSource(str(other), "data", data.shape)
    file.create_virtual_dataset("data", layout)


def _outside(file, other, data):
    place = [(str(other), 0, data.nbytes)]
    file.create_dataset("data", data.shape, data.dtype, external=place)


def _group(file, other, data):
    file["data/first"] = data


def _null(file, other, data):
    file["data"] = h5py.Empty("f4")


def _absent(file, other, data):
    pass


@pytest.mark.parametrize(
    ("put", "message"),
    [
        (_linked, "data is a link"),
        (_linked_within, "data is a link"),
        (_virtual, "data lies in other files"),
        (_outside, "data lies in other files"),
        (_group, "data is no array"),
        (_null, "data is no array"),
        (_absent, "data is not in the file"),
    ],
)
def test_data_of_other_files_are_not_read(tmp_path, arrays, put, message):
    other = save(tmp_path / "elsewhere" / "secret.h5", **arrays)
    path = tmp_path / "ply_data_train0.h5"
    with h5py.File(path, "w") as file:
        file["label"] = arrays["label"]
        put(file, other, arrays["data"])
    with refused(message, f"{path}: "):
        read_hdf5(path)


def test_file_that_would_unpack_beyond_the_ceiling_is_refused(tmp_path, arrays, monkeypatch):
    path = tmp_path / "train_0.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("data", (10**6, 2048, 6), "<f8", chunks=(1, 2048, 6))
        file["label"] = np.zeros(6, int)
    with refused("data has 98304000000 bytes, more than the limit", path):
        read_hdf5(path)
    monkeypatch.setattr(reading, "MOST_BYTES", 1000)
    with refused("the file has .* more than the limit of 1000", path):
        read_hdf5(path)


def test_convention_y_up_turns_to_z_up(rng):
    # x to the right, y up, z to the viewer, as OpenGL has them.
    right, up, near = np.eye(3)
    turned = y_up_to_z_up(np.stack([right, up, near]))
    assert turned.tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    assert np.linalg.det(turned) == 1  # a turn, no mirror
    cloud = hard_floats(rng, 500)  # four turns round nothing
    again = y_up_to_z_up(y_up_to_z_up(y_up_to_z_up(y_up_to_z_up(cloud))))
    assert again.tobytes() == cloud.tobytes()
