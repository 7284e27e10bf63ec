import io
import struct
import tracemalloc

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import InputError
from qs3.io.clouds import RaggedClouds
from qs3.io.layouts.point_folders import file_stem, read_folder, write_folder
from qs3.io.load import load_unlabelled
from qs3.io.point_files import WRITTEN_FILES, cloud_bytes, read_cloud

from ..hostile import fuzz
from .common import content, hard_floats, make_clouds


def unlabelled(clouds, splits=()):
    ids = tuple(f"scene/{i}" for i in range(len(clouds)))
    return RaggedClouds(clouds=clouds, ids=ids, checksum="", splits=splits)


def independent(path):
    """Read a file without our readers."""
    content = path.read_bytes()
    if path.suffix == ".npy":
        return np.load(io.BytesIO(content), allow_pickle=False)
    if path.suffix == ".xyz":
        rows = [[float(word) for word in line.split()] for line in content.decode().splitlines()]
        return np.array(rows).astype(np.float32)
    if path.suffix == ".ply":
        return np.asarray(trimesh.load(path, process=False).vertices).astype(np.float32)
    header, _, body = content.partition(b"DATA binary\n")
    fields = dict(line.split(" ", 1) for line in header.decode().splitlines()[1:])
    assert (fields["FIELDS"], fields["SIZE"], fields["TYPE"]) == ("x y z", "4 4 4", "F F F")
    count = int(fields["POINTS"])
    assert count == int(fields["WIDTH"]) * int(fields["HEIGHT"])
    return np.array(list(struct.iter_unpack("<fff", body[: 12 * count])), dtype=np.float32)


@pytest.mark.parametrize("ending", WRITTEN_FILES)
@pytest.mark.parametrize("splits", [("train", "test"), ("",), ("", "test")])
def test_what_is_written_reads_back_equal(rng, tmp_path, ending, splits):
    clouds = make_clouds(rng, ("Night Stand", "Stühle 1", "bed"), 50, 3, splits)
    write_folder(tmp_path / "set", clouds, ending)
    back = read_folder(tmp_path / "set")
    assert content(back) == content(clouds)
    assert back.class_names == ("Night Stand", "Stühle 1", "bed")
    if "test" in splits:
        test = read_folder(tmp_path / "set", "test")
        assert set(test.splits) == {"test"}
        assert len(test.ids) == 9


@pytest.mark.parametrize("ending", WRITTEN_FILES)
def test_a_file_reads_equal_by_other_readers(rng, tmp_path, ending):
    points = hard_floats(rng, 500)
    path = tmp_path / f"a{ending}"
    path.write_bytes(cloud_bytes(points, ending))
    # Bits, so that the sign of zero counts.
    np.testing.assert_array_equal(independent(path).view(np.uint32), points.view(np.uint32))
    np.testing.assert_array_equal(read_cloud(path).view(np.uint32), points.view(np.uint32))


def test_clouds_without_labels_keep_their_splits(rng, tmp_path):
    clouds = [rng.random((5, 3)).astype(np.float32) for _ in range(3)]
    write_folder(tmp_path / "flat", unlabelled(clouds), ".npy")
    assert sorted(path.name for path in (tmp_path / "flat").iterdir())[0] == "scene_0.npy"
    write_folder(tmp_path / "parts", unlabelled(clouds, ("train", "train", "test")), ".npy")
    back = read_folder(tmp_path / "parts")
    assert back.labels is None
    assert sorted(back.splits) == ["test", "train", "train"]
    assert load_unlabelled(tmp_path / "parts", split="test", num_points=5).points.shape[0] == 1
    with pytest.raises(InputError, match="a split and others none"):
        write_folder(tmp_path / "no", unlabelled(clouds, ("train", "", "test")), ".npy")
    assert not (tmp_path / "no").exists()


def test_a_tree_with_the_split_first(rng, tmp_path):
    for part in ("train", "test"):
        for name in ("bed", "sofa"):
            (tmp_path / part / name).mkdir(parents=True)
            np.save(tmp_path / part / name / "a.npy", rng.random((4, 3)))
    clouds = read_folder(tmp_path)
    assert clouds.class_names == ("bed", "sofa")
    assert sorted(clouds.ids)[0] == "test/bed/a.npy"
    assert sorted(clouds.splits) == ["test", "test", "train", "train"]
    np.save(tmp_path / "train" / "stray.npy", rng.random((4, 3)))
    with pytest.raises(InputError, match=r"beside them \(stray\.npy\)"):
        read_folder(tmp_path)


def test_a_class_that_is_named_train_is_a_class(rng, tmp_path):
    for part in ("train", "test"):
        (tmp_path / "train" / part).mkdir(parents=True)
        np.save(tmp_path / "train" / part / "a.npy", rng.random((4, 3)))
    assert read_folder(tmp_path).class_names == ("train",)
    assert len(read_folder(tmp_path, "test").ids) == 1


@settings(max_examples=50, deadline=None)
@given(st.text(max_size=300), st.sampled_from(["", "chair", "chair/train"]))
def test_no_id_leads_outside_or_makes_no_file(identifier, folder):
    stem = file_stem(identifier, folder)
    assert stem
    assert stem.isascii()
    assert not set(stem) & set('/\\:*?"<>|\0\n #')
    assert stem[0] != "."
    assert len(stem) <= 180


def test_hostile_ids_stay_in_the_folder(rng, tmp_path):
    ids = ("../../evil", "/etc/passwd", "a\0b", "..", ".", "", "x" * 5000, "x" * 4999 + "y", "A",
           "a", "C:\\x", ".hidden", "bed/train/../../../up", "a.npy", "\ud800")  # fmt: skip
    clouds = [np.full((2, 3), i, dtype=np.float32) for i in range(len(ids))]
    labels = np.zeros(len(ids), dtype=np.int64)
    ragged = RaggedClouds(clouds, ids, "", labels, ("bed",), ("train",) * len(ids))
    root = tmp_path / "inner" / "set"
    write_folder(root, ragged, ".npy")
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
        write_folder(tmp_path / "set", clouds, ".npy")
    assert not (tmp_path / "set").exists()


def test_classes_and_splits_that_no_folder_tells_apart_are_refused(tmp_path):
    pair = [np.zeros((2, 3))] * 2
    clouds = RaggedClouds(pair, ("a", "b"), "", np.array([0, 1]), ("Bed", "bed"))
    with pytest.raises(InputError, match="differ in capitals only"):
        write_folder(tmp_path / "set", clouds, ".npy")
    clouds = RaggedClouds(pair, ("a", "b"), "", np.array([0, 0]), ("bed",), ("train", "dev"))
    with pytest.raises(InputError, match="split 'dev' has no folder"):
        write_folder(tmp_path / "set", clouds, ".npy")


def npy_header(shape: str, kind: str = "<f4") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def ply_header(form: str, lines: str) -> bytes:
    return f"ply\nformat {form} 1.0\n{lines}\nend_header\n".encode()


XYZ = "property float x\nproperty float y\nproperty float z"
HOSTILE = {
    "ply of 10 GB": ("a.ply", ply_header("binary_little_endian", f"element vertex 900000000\n{XYZ}")
                     + bytes(60), "900000000 vertex.* announces"),
    "ply text of 10 GB": ("a.ply", ply_header("ascii", f"element vertex 900000000\n{XYZ}")
                          + b"1 2 3\n", "900000000 vertex.* announces"),
    "ply beyond 64 bits": ("a.ply", ply_header("ascii", f"element vertex {10**30}\n{XYZ}")
                           + b"1 2 3\n", "announces 6000000"),
    "ply faces": ("a.ply", ply_header(
        "binary_little_endian",
        f"element vertex 1\n{XYZ}\nelement face 900000000\nproperty list uchar int vertex_indices",
    ) + bytes(60), "1 vertex, 900000000 face.* announces"),
    "ply rows of nothing": ("a.ply", ply_header(
        "binary_little_endian", f"element void 900000000\nelement vertex 1\n{XYZ}") + bytes(12),
        "lacks the format or a property"),
    "ply negative": ("a.ply", ply_header("ascii", f"element vertex -1\n{XYZ}"), "read as ply"),
    "ply list": ("a.ply", ply_header(
        "ascii", f"element vertex 2\n{XYZ}\nproperty list int float w") + b"1 2 3 1 2 4 5 6 0",
        "lists in or before"),
    "ply twice x": ("a.ply", ply_header("ascii", f"element vertex 1\n{XYZ}\nproperty int x")
                    + b"1 2 3 4", "each property once"),
    "ply no z": ("a.ply", ply_header("ascii", "element vertex 2\nproperty float x") + b"1\n2\n",
                 "properties x, y and z"),
    "ply words": ("a.ply", ply_header("ascii", f"element vertex 1\n{XYZ}") + b"11111111",
                  "cannot be read as ply"),
    "ply endless header": ("a.ply", b"ply\n" + (b"comment ".ljust(60) + b"\n") * 20_000,
                           "no end_header"),
    "pcd of 10 GB": ("a.pcd", b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"
                     b"POINTS 900000000\nDATA binary\n" + bytes(60), "announces 32400000000 bytes"),
    "pcd wide": ("a.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 2000000000\n"
                 b"POINTS 1\nDATA binary\n" + bytes(60), "cannot be read as pcd"),
    "pcd negative": ("a.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS -2\nDATA binary\n"
                     + bytes(60), "header is incomplete"),
    "pcd bomb": ("a.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 357000000\n"
                 b"DATA binary_compressed\n" + struct.pack("<II", 52, 357000000 * 12) + bytes(52),
                 "announces 12852000000"),
    "pcd endless header": ("a.pcd", (b"#".ljust(60) + b"\n") * 20_000, "no DATA line"),
    "npy of 10 GB": ("a.npy", npy_header("(900000000, 3)") + bytes(60), "announces 10800000000"),
    "npy beyond 64 bits": ("a.npy", npy_header(f"({10**30}, 3)"), "announces"),
    "npy negative": ("a.npy", npy_header("(-1, 3)") + bytes(60), "npy"),
    "npy code": ("a.npy", npy_header("__import__('os').getpid()"), "cannot be read as npy"),
    "off of 10 GB": ("a.off", b"OFF\n900000000 0 0\n1 2 3\n", "cannot be read as off"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_header_that_announces_too_much_is_refused_before_memory_is_taken(tmp_path, case):
    name, content, message = HOSTILE[case]
    (tmp_path / name).write_bytes(content)
    if name.endswith(".off"):
        import qs3.meshes.normalising  # noqa: F401 (the import itself takes memory)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=message) as caught:
            read_cloud(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 8 * 2**20
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian", "binary_little_endian"])
def test_a_ply_with_other_columns_and_elements_around_its_vertices(tmp_path, form):
    lines = (
        "comment made by hand\nelement camera 1\nproperty double focal\n"
        "element vertex 2\nproperty uchar red\nproperty double z\nproperty float x\n"
        "property short y\nelement face 0\nproperty list uchar int vertex_indices"
    )
    order = ">" if "big" in form else "<"
    body = struct.pack(f"{order}dBdfhBdfh", 1.5, 9, 3, 1, 2, 8, 6, 4, 5)
    if form == "ascii":
        body = b"1.5\n9 3 1 2\n8 6 4 5\n"
    header = ply_header(form, lines).replace(b"\n", b"\r\n" if form == "ascii" else b"\n")
    (tmp_path / "a.ply").write_bytes(header + body)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply"), [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("ending", [*WRITTEN_FILES, ".off", "mesh.ply"])
def test_mutated_files_give_points_or_one_clear_line(rng, tmp_path, ending):
    points = rng.random((40, 3)).astype(np.float32)
    ball = trimesh.creation.icosphere(subdivisions=1)
    whole = {".off": lambda: ball.export(file_type="off").encode(),
             "mesh.ply": lambda: ball.export(file_type="ply")}  # fmt: skip
    path = tmp_path / f"a{ending}"
    path.write_bytes(whole.get(ending, lambda: cloud_bytes(points, ending))())

    def read(path):
        result = read_cloud(path, mesh_points=20)
        assert result.dtype == np.float32
        assert result.shape[1] == 3
        assert np.isfinite(result).all()

    fuzz([path], read, rng, 60)
