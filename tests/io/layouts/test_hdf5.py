import time

import h5py
import numpy as np
import pytest

from qs3.errors import InputError
from qs3.geometry import y_up_to_z_up, z_up_to_y_up
from qs3.io import guards
from qs3.io.layouts import hdf5
from qs3.io.layouts.hdf5 import hdf5_bytes, read_file
from qs3.io.layouts.hdf5_sets import list_parts, read_parts

from ..hostile import fuzz, refused
from .common import hard_floats

FILES = r"(train|test)_(\d+)\.h5"


@pytest.fixture
def arrays(rng):
    """Six clouds of eight points with a colour, of four classes."""
    data = rng.normal(size=(6, 8, 6)).astype(np.float32)
    return {"data": data, "label": np.array([0, 3, 1, 2, 0, 3], dtype=np.int32)}


def save(path, **datasets):
    with h5py.File(path, "w") as file:
        for name, array in datasets.items():
            file.create_dataset(name, data=array)
    return path


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", "<f2"])
@pytest.mark.parametrize("columns", [3, 6])
def test_floats_of_every_kind_are_read(tmp_path, arrays, kind, columns):
    data = arrays["data"][..., :columns].astype(kind)
    for label in (arrays["label"], arrays["label"].astype(np.uint8)[:, None]):
        points, labels = read_file(save(tmp_path / "a.h5", data=data, label=label), (3, 6), 4)
        assert points.dtype == np.float32
        np.testing.assert_array_equal(points, data[..., :3].astype(np.float32))
        np.testing.assert_array_equal(labels, arrays["label"])


@pytest.mark.parametrize("block", [1, 200, 2**24])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "gzip", "shuffle": True, "fletcher32": True},
        {"compression": "lzf", "chunks": (4, 3, 2)},
        {"chunks": (5, 8, 6), "maxshape": (None, 8, 6)},
    ],
)
def test_blocks_and_chunks_change_nothing(tmp_path, arrays, options, block, monkeypatch):
    monkeypatch.setattr(hdf5, "_BLOCK", block)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("data", data=arrays["data"], **options)
        file.create_dataset("label", data=arrays["label"])
    points, _ = read_file(tmp_path / "a.h5", (6,), 4)
    np.testing.assert_array_equal(points, arrays["data"][..., :3])


def test_equal_arrays_give_equal_bytes_at_any_time(arrays):
    first = hdf5_bytes(arrays)
    time.sleep(1.1)
    assert hdf5_bytes(arrays) == first


def missing(name):
    return lambda file, *_: file.pop(name)


def replace(name, **options):
    def change(file, arrays, folder):
        del file[name]
        given = {key: v(arrays) if callable(v) else v for key, v in options.items()}
        file.create_dataset(name, **given)

    return change


def soft_link(file, arrays, folder):
    file["real"] = file["data"]
    del file["data"]
    file["data"] = h5py.SoftLink("/real")


def external_link(file, arrays, folder):
    del file["data"]
    file["data"] = h5py.ExternalLink("other.h5", "/data")


def external_storage(file, arrays, folder):
    (folder / "secret").write_bytes(arrays["data"].tobytes())
    del file["data"]
    size = arrays["data"].nbytes
    place = [(str(folder / "secret"), 0, size)]
    file.create_dataset("data", shape=(6, 8, 6), dtype="<f4", external=place)


def virtual(file, arrays, folder):
    save(folder / "other.h5", data=arrays["data"])
    layout = h5py.VirtualLayout(shape=(6, 8, 6), dtype="<f4")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "data", shape=(6, 8, 6))
    del file["data"]
    file.create_virtual_dataset("data", layout)


def group(file, arrays, folder):
    del file["data"]
    file.create_group("data")


MANY = {"shape": (10**5, 2048, 6), "dtype": "<f8"}
VLEN = {"shape": (6, 8, 3), "dtype": h5py.vlen_dtype(np.float32)}
LABELS = {"shape": (10**12,), "dtype": "<i8", "chunks": (1000,)}
BOMB = {"data": np.zeros((6, 200000, 6), np.float32), "compression": "gzip", "compression_opts": 9}
CHUNK = {"shape": (6, 8, 6), "maxshape": (None, None, 6), "chunks": (60000, 2048, 6),
         "dtype": "<f4", "compression": "gzip"}  # fmt: skip


def plugin(file, arrays, folder):
    del file["data"]
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk((6, 8, 6))
    plist.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)
    space = h5py.h5s.create_simple((6, 8, 6))
    dataset = h5py.h5d.create(file.id, b"data", h5py.h5t.IEEE_F32LE, space, plist)
    dataset.write(space, space, arrays["data"])


def point(value, kind="<f4"):
    def data(arrays):
        changed = arrays["data"].astype(kind)
        changed[2, 3, 1] = value
        return changed

    return replace("data", data=data)


HOSTILE = {
    "missing data": (missing("data"), "has no dataset 'data', only 'label'"),
    "missing label": (missing("label"), "has no dataset 'label', only 'data'"),
    "two axes": (replace("data", data=np.ones((6, 8))), r"shape \[b n 3 or 6\], not float64"),
    "four columns": (replace("data", data=np.ones((6, 8, 4))), r"of shape \[6, 8, 4\]"),
    "whole numbers": (replace("data", data=np.ones((6, 8, 3), int)), "must be floats"),
    "text": (replace("data", data=np.full((6, 8, 3), b"x")), "no plain numbers"),
    "compound": (
        replace("data", data=np.zeros((6, 8, 3), [("x", "f4"), ("y", "f4")])),
        "no plain numbers",
    ),
    "variable length": (replace("data", **VLEN), "no plain numbers"),
    "nothing": (replace("data", data=h5py.Empty("f4")), "no plain numbers"),
    "one number": (replace("data", data=np.float32(1)), "must be floats of shape"),
    "no cloud": (replace("data", shape=(0, 8, 3), dtype="f4"), "label must be"),
    "no point": (replace("data", shape=(6, 0, 3), dtype="f4"), "holds no point"),
    "labels of others": (replace("label", data=np.zeros(5, int)), r"numbers of shape \[6\]"),
    "two labels a cloud": (replace("label", data=np.zeros((6, 2), int)), "label must be"),
    "label of floats": (replace("label", data=np.zeros(6)), "label must be whole numbers"),
    "label too high": (replace("label", data=np.full(6, 4)), "label 4 is none of 0 to 3"),
    "label negative": (replace("label", data=np.full(6, -1)), "label -1 is none of"),
    "label of 2**64 - 1": (
        replace("label", data=np.full(6, 2**64 - 1, np.uint64)),
        "label 18446744073709551615 is none of",
    ),
    "not a number": (point(np.nan), "cloud 2 has a point that is not finite"),
    "infinite": (point(-np.inf), "cloud 2 has a point that is not finite"),
    "beyond float32": (point(1e200, "<f8"), "cloud 2 has a point that is not finite"),
    "soft link": (soft_link, "data is a link"),
    "external link": (external_link, "data is a link"),
    "external storage": (external_storage, "data lies in another file"),
    "virtual": (virtual, "data lies in another file"),
    "group": (group, "data is no dataset"),
    "announced only": (replace("data", **MANY), r"announces 9830400000 bytes"),
    "announced chunks": (replace("data", **MANY, chunks=(1, 2048, 6)), "announces 9830400000 byte"),
    "labels announced": (replace("label", **LABELS), r"label announces 8000000000000 bytes"),
    "bomb": (replace("data", **BOMB), r"announces 28800000 bytes"),
    "huge chunk": (replace("data", **CHUNK), r"announces 2949120000 bytes"),
    "plugin": (plugin, "compressed by a plugin"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_before_their_points_are_read(
    tmp_path, arrays, name, monkeypatch
):
    monkeypatch.setattr(guards, "_SLACK", 2**20)
    change, message = HOSTILE[name]
    path = save(tmp_path / "a.h5", **arrays)
    with h5py.File(path, "a") as file:
        change(file, arrays, tmp_path)
    if name not in ("not a number", "infinite", "beyond float32"):
        monkeypatch.setattr(hdf5, "_points", lambda data: pytest.fail("read the points"))
    with refused(message, f"{path}: "):
        read_file(path, (3, 6), 4)


def test_what_is_no_hdf5_file_is_refused(tmp_path, arrays):
    whole = hdf5_bytes(arrays)
    contents = [b"", b"no", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + b"\xff" * 4000]
    for content in (*contents, *(whole[: len(whole) * part // 10] for part in range(1, 10))):
        (tmp_path / "a.h5").write_bytes(content)
        with refused(r"a\.h5: cannot be read as HDF5"):
            read_file(tmp_path / "a.h5", (6,), 4)
    for path in (tmp_path, tmp_path / "none.h5"):
        with pytest.raises(InputError, match="no such file"):
            read_file(path, (6,), 4)


@pytest.mark.parametrize("compression", [None, "gzip"])
def test_damaged_bytes_are_read_or_refused_in_one_line(tmp_path, rng, arrays, compression):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("data", data=arrays["data"], compression=compression)
        file.create_dataset("label", data=arrays["label"])
    fuzz([tmp_path / "a.h5"], lambda path: read_file(path, (6,), 4), rng, 150)


def test_parts_are_listed_in_order(tmp_path, arrays):
    for name in ("train_10.h5", "train_2.h5", "test_0.h5", "train_2.h5.bak", "notes.txt"):
        save(tmp_path / name, **arrays)
    names = [part.path.name for part in list_parts(tmp_path, FILES, "h5", None)]
    assert names == ["train_2.h5", "train_10.h5", "test_0.h5"]
    # A list has the last word on what belongs, and on the order.
    (tmp_path / "train_files.txt").write_text("./train_10.h5\r\n\r\ndata/x/train_2.h5\n")
    names = [part.path.name for part in list_parts(tmp_path, FILES, "h5", "train")]
    assert names == ["train_10.h5", "train_2.h5"]
    with pytest.raises(InputError, match="no split 'val', only test, train"):
        list_parts(tmp_path, FILES, "h5", "val")
    clouds = read_parts(list_parts(tmp_path, FILES, "h5", None), "abcd", (6,))
    assert clouds.ids[5:7] == ("train_10/00005", "train_2/00000")
    assert len(set(clouds.ids)) == 18
    assert clouds.splits == ("train",) * 12 + ("test",) * 6


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("../train_0.h5", "is no .h5 file of its folder"),
        ("a/../../train_0.h5", "is no .h5 file of its folder"),
        ("..\\train_0.h5", "is no .h5 file of its folder"),
        ("/data/train_0.h5", "is no .h5 file of its folder"),
        ("C:\\data\\train_0.h5", "is no .h5 file of its folder"),
        ("https://example.org/train_0.h5", "is no .h5 file of its folder"),
        ("train_\0.h5", "is no .h5 file of its folder"),
        ("x" * 5000 + ".h5", "is no .h5 file of its folder"),
        ("data/", "is no .h5 file of its folder"),
        ("passwd", "is no .h5 file of its folder"),
        ("train_0.h5\ntrain_0.h5", "train_0.h5 is listed twice"),
        ("train_7.h5", r"train_7\.h5: no such file"),
        ("linked.h5", "leads out of its folder"),
        ("train_0.h5\n" * 100000, "too long"),
    ],
)
def test_lists_lead_nowhere_else(tmp_path, arrays, line, message):
    save(tmp_path / "outside.h5", **arrays)
    root = tmp_path / "root"
    root.mkdir()
    save(root / "train_0.h5", **arrays)
    (root / "linked.h5").symlink_to(tmp_path / "outside.h5")
    (root / "train_files.txt").write_text(line)
    with refused(message):
        read_parts(list_parts(root, FILES, "h5", None), "abcd", (6,))


def test_a_list_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "train_files.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="no text in UTF-8"):
        list_parts(tmp_path, FILES, "train_<i>.h5", None)
    (tmp_path / "train_files.txt").unlink()
    with pytest.raises(InputError, match=r"holds no train_<i>\.h5"):
        list_parts(tmp_path, FILES, "train_<i>.h5", None)
    with pytest.raises(InputError, match="no such folder"):
        list_parts(tmp_path / "none", FILES, "train_<i>.h5", None)


def test_convention_y_up_turns_to_z_up_and_back():
    # x to the right, y up, z to the viewer, as OpenGL has them.
    right, up, near = np.eye(3)
    turned = y_up_to_z_up(np.stack([right, up, near]))
    assert turned.tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    assert np.linalg.det(turned) == 1  # a turn, no mirror
    np.testing.assert_array_equal(z_up_to_y_up(turned), np.eye(3))


def test_turning_rounds_nothing(rng):
    cloud = hard_floats(rng, 500)
    assert y_up_to_z_up(z_up_to_y_up(cloud)).tobytes() == cloud.tobytes()
    assert z_up_to_y_up(y_up_to_z_up(cloud)).tobytes() == cloud.tobytes()
