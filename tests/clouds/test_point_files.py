import contextlib
import io
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3.answers.cloud_files import list_clouds
from qs3.clouds.files import depth_hint, read_cloud
from qs3.clouds.load import convert, detect, read_clouds
from qs3.clouds.ply_writer import ply_bytes
from qs3.clouds.preparation import measured, single
from qs3.errors import TOLD, InputError

from .hostile import refused

POINTS = np.array([[0.5, -1.25, 3.0], [1e-3, 2.0, -7.5], [0.0, 0.0, 0.25]], dtype=np.float32)
NORMALS = np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0]], dtype=np.float32)


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def npy_header(shape: str) -> bytes:
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def text(separator: str) -> bytes:
    rows = np.hstack([POINTS, NORMALS])
    lines = [separator.join(str(value) for value in row) for row in rows]
    return ("# x y z nx ny nz\n" + "\n".join(lines) + "\n\n").encode()


def ply(encoding: str) -> bytes:
    return trimesh.PointCloud(POINTS).export(file_type="ply", encoding=encoding)


def pcd_header(data: str, count: int = 3) -> bytes:
    """Fields out of order, with a colour between and a histogram of four after."""
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS z rgb x y hist\n"
        "SIZE 8 4 4 4 2\nTYPE F U F F I\nCOUNT 1 1 1 1 4\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    ).encode()


def pcd_ascii() -> bytes:
    rows = [f"{z} 255 {x} {y} 1 2 3 4" for x, y, z in POINTS.tolist()]
    return pcd_header("ascii") + "\n".join(rows).encode() + b"\n"


def pcd_binary(points: np.ndarray = POINTS) -> bytes:
    rows = [struct.pack("<dIff4h", z, 255, x, y, 1, 2, 3, 4) for x, y, z in points.tolist()]
    return pcd_header("binary", len(points)) + b"".join(rows)


def pcd_compressed() -> bytes:
    """Field after field in LZF: plain runs, and what lies 4 or 8 bytes back, again and again."""
    z, x, y = POINTS[:, 2].astype("<f8"), *POINTS[:, :2].T.astype("<f4")
    plain = [
        z.tobytes(),
        struct.pack("<I", 255),
        x.tobytes() + y.tobytes(),
        struct.pack("<4h", 1, 2, 3, 4),
    ]
    runs = [bytes([len(run) - 1]) + run for run in plain]
    again = [b"", bytes([(8 - 2) << 5, 4 - 1]), b"", bytes([7 << 5, 16 - 2 - 7, 8 - 1])]
    packed = b"".join(run + more for run, more in zip(runs, again, strict=True))
    return pcd_header("binary_compressed") + struct.pack("<II", len(packed), 84) + packed


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.npy", npy(POINTS)),
        ("a.npy", npy(np.hstack([POINTS, NORMALS]).astype(np.float64))),
        ("a.XYZ", text(" ")),
        ("a.txt", text(",")),
        ("a.txt", text("\t").replace(b"\n", b"\r\n")),
        ("a.ply", ply("ascii")),
        ("a.ply", ply("binary_little_endian")),
        ("ascii.pcd", pcd_ascii()),
        ("binary.pcd", pcd_binary()),
        ("compressed.pcd", pcd_compressed()),
        (
            "windows.pcd",
            pcd_ascii().replace(b"3\nHEIGHT", b"4\nHEIGHT").replace(b"POINTS 3", b"POINTS 4")
            + b"-nan(ind) 0 -nan(ind) 1.#QNAN 1 2 3 4\n",
        ),
        (
            "windows.ply",
            ply("ascii").replace(b"vertex 3", b"vertex 5").rstrip()
            + b"\n-nan(ind) -nan(ind) -nan(ind)\n1.#QNAN 1.#QNAN 1.#QNAN\n",
        ),
        ("minus.csv", text(",").decode().replace("-", "\u2212").encode()),
        ("pixel_that_saw_nothing.pcd", pcd_binary(np.insert(POINTS, 1, np.nan, axis=0))),
        ("a.off", b"OFF\n3 0 0\n" + b"\n".join(f"{x} {y} {z}".encode() for x, y, z in POINTS)),
    ],
)
def test_every_format_gives_the_same_points(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    points = read_cloud(tmp_path / name)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points, POINTS)


_ROWS = "\n".join(" ".join(map(str, row)) for row in POINTS.tolist())
_PLY = "ply\nformat ascii 1.0\n{}element vertex 3\n"
_PLY += "".join(f"property float {axis}\n" for axis in "xyz") + f"end_header\n{_ROWS}\n"
_OFF = "OFF\n{}3 0 0\n" + _ROWS


@pytest.mark.parametrize(
    ("name", "content", "scale"),
    [
        ("a.xyz", "# units: mm\n" + _ROWS, 1e-3),
        ("a.xyz", "// Coordinates are in centimetres.\n" + _ROWS, 1e-2),
        ("a.csv", "# unit = inch\nx y z\n" + _ROWS, 0.0254),
        ("a.csv", "# units: mm\n# x[mm] y[mm] z[mm]\n" + _ROWS, 1e-3),
        ("a.xyz", "# x[mm] y[mm] z[mm] and more\n" + _ROWS, 1e-3),
        ("a.csv", "# units: m\nx [m],y [m],z [m]\n" + _ROWS.replace(" ", ","), 1),
        ("a.csv", "x [m],y,z\n" + _ROWS.replace(" ", ","), 1),
        ("a.xyz", "# Length unit: mm\n" + _ROWS, 1e-3),
        ("a.xyz", "# unit vectors, units in the header\n" + _ROWS, 1),
        ("a.xyz", "# voxel size units: mm\n# normal units in mm\n" + _ROWS, 1),
        ("a.xyz", "# sensor resolution (unit: mm): 0.5\n# time unit: um\n" + _ROWS, 1),
        ("a.ply", _PLY.format("comment distance unit feet from sensor\n"), 1),
        ("a.xyz", "# unit: m\n# Units (metres)\n" + _ROWS, 1),
        *(
            ("a.xyz", f"{names}\n{_ROWS}", 1e-3)
            for names in ("# x, y, z in millimetres", "# Coordinates [mm]: x y z", "x y z [mm]")
        ),
        *(
            ("a.xyz", f"# {words}\n{_ROWS}", 1e-3)
            for words in (
                "exported by X from note.step, units: mm",
                "Saved by X. All units are in millimeters",
                "units: mm, roughness in um, from foot.stl",
                "Generated by X with units mm, seen from 1.5 m",
                "all dimensions in mm",
                "The units are millimeters",
                "Scale: 1 unit = 1 mm",
            )
        ),
        *(
            ("a.xyz", f"# {words}\n{_ROWS}", 1)
            for words in (
                "voxel size 5, units: mm",
                "scaled to metres; original units: mm",
                "0.1 unit = 1 mm",
                "X, points in mm/s",
                "scalar field 1, values in mm",
                "the centre of all points in mm: 1 2 3",
                "X | unit=mm",
                "scan of the model in mm (bolt.stl)",
                "registered to points in mm",
                "CAD model in mm, scan in m",
                "units: mm, now metres",
                "scaled 0.001 from the model in mm",
                "mm to m: 0.001; unit: mm before",
                "laser wavelength 0.9, unit: um",
            )
        ),
        ("a.ply", _PLY.format("comment made by X, unit: mm\n"), 1e-3),
        ("a.ply", _PLY.format("comment this file uses millimeters as units\n"), 1e-3),
        ("a.xyz", "# x y z in the frame of mm.stl\n" + _ROWS, 1),
        ("a.xyz", "#" * 300_000 + "\n" + _ROWS, 1),  # took minutes
        ("a.ply", _PLY.format("comment units mm\n"), 1e-3),
        ("a.ply", _PLY.format("obj_info unit: millimeter\n"), 1e-3),
        ("a.ply", _PLY.format("comment a unit sphere\n"), 1),
        ("a.off", _OFF.format("# unit: cm\n"), 1e-2),
        ("a.pcd", "# units mm\n" + pcd_ascii().decode(), 1e-3),
    ],
)
def test_a_comment_names_the_unit(tmp_path, caplog, name, content, scale):
    TOLD.clear()
    (tmp_path / name).write_text(content)
    np.testing.assert_allclose(read_cloud(tmp_path / name), scale * POINTS, rtol=1e-6)
    line = f"{tmp_path / name}: points are converted from"
    by_columns = re.search(r"(?i)x ?[\[(]mm[\])]", content)
    assert (line in caplog.text) == (scale != 1 and not by_columns)


@pytest.mark.parametrize(
    ("comment", "is_said"),
    [
        *((words, True) for words in ("X | unit=mm", "Matlab export, units: mm", "1 unit = 0.001 m",
                                      "Units: 1 = 1 mm", "scan 3 (unit = 0.001 m)", "unit: 1 mm",
                                      "numbers in mm units", "X uses inches as units")),
        *((words, False) for words in ("X | unit=m", "a unit vector", "scan 3, unit: 1 m",
                                       "x y z [m]", "units: m")),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["a.xyz", "a.ply", "a.pcd"])
def test_a_unit_of_a_comment_that_does_not_count_is_reported(
    tmp_path, caplog, name, comment, is_said
):
    TOLD.clear()
    text = {
        "a.xyz": f"# {comment}\n{_ROWS}",
        "a.ply": _PLY.format(f"comment {comment}\n"),
        "a.pcd": f"# {comment}\n{pcd_ascii().decode()}",
    }[name]
    (tmp_path / name).write_text(text)
    np.testing.assert_allclose(read_cloud(tmp_path / name), POINTS, rtol=1e-6)
    line = f"{tmp_path / name}: the comment {comment!r} does not count as the unit of points"
    assert (line in caplog.text) == is_said


@pytest.mark.parametrize(
    ("head", "scale"),
    [
        ("x,y,z\n[mm],[mm],[mm]\n", 1e-3),
        ('"x","y","z"\n"cm","cm","cm"\n', 1e-2),
        ("X;Y;Z\nm;m;m\n", 1),
        ("X,Y,Z,i\nmm,mm,mm,-\n", 1e-3),
        ("x y z\nmm mm mm\n", 1e-3),
        ("# made by X\nx\ty\tz\n(cm)\t(cm)\t(cm)\n", 1e-2),
    ],
)
def test_a_row_below_the_names_may_hold_units(tmp_path, head, scale):
    sign = next(sign for sign in ",;\t " if sign in head.splitlines()[-1])
    rows = _ROWS.replace("\n", " 7\n") + " 7" if "i" in head else _ROWS
    (tmp_path / "a.csv").write_text(head + rows.replace(" ", sign))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.csv"), scale * POINTS, rtol=1e-6)


@pytest.mark.parametrize(
    "comment",
    ["# units: feet", "# unit: mm\n# unit: m", "# units: \u00b5m", "# units: feet, 1 is not a m"],
)
def test_units_of_comments_that_are_unknown_or_differ_are_refused(tmp_path, comment):
    (tmp_path / "a.xyz").write_text(f"{comment}\n{_ROWS}", encoding="utf-8")
    with refused("name the unit .*; write it in m, cm, mm or in", tmp_path / "a.xyz"):
        read_cloud(tmp_path / "a.xyz")


@pytest.mark.parametrize(
    "head",
    ["x,y,z\nnan,nan,nan\n", "x,y,z\nNaN,1,NaN\n", "x,y,z\ninf,inf,inf\n", "x y z\nnan nan nan\n"],
)
def test_a_first_row_without_a_measurement_is_no_row_of_units(tmp_path, head):
    rows = _ROWS.replace(" ", ",") if "," in head else _ROWS
    (tmp_path / "a.csv").write_text(head + rows)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.csv"), POINTS)


def test_a_ply_of_a_scan_with_faces_gives_its_vertices(tmp_path):
    y, x = np.mgrid[:30, :40] / 50
    points = np.stack([x.ravel(), y.ravel(), np.hypot(x, y).ravel()], axis=1).astype(np.float32)
    corner = (np.arange(29)[:, None] * 40 + np.arange(39)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 40], corner[:, None] + [1, 41, 40]])
    trimesh.Trimesh(points, faces, process=False).export(tmp_path / "scan.ply")
    np.testing.assert_array_equal(read_cloud(tmp_path / "scan.ply"), points)
    trimesh.Trimesh(points, [[0, 39, 1160]], process=False).export(tmp_path / "few.ply")
    np.testing.assert_array_equal(read_cloud(tmp_path / "few.ply"), points)


@pytest.mark.parametrize("suffix", ["off", "ply"])
def test_a_mesh_gives_seeded_samples_of_its_surface(tmp_path, suffix):
    path = tmp_path / f"ball.{suffix}"
    trimesh.creation.icosphere(subdivisions=1 if suffix == "ply" else 4).export(path)
    points = read_cloud(path)
    assert points.shape == (2048, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=0.2)
    np.testing.assert_array_equal(points, read_cloud(path))


@pytest.mark.parametrize("spare", [20, 90])
def test_a_mesh_with_vertices_in_no_face_is_sampled_too(tmp_path, spare):
    box = trimesh.creation.box((1, 1, 1))
    unused = np.random.default_rng(0).random((spare, 3)) - 0.5
    vertices = np.concatenate([box.vertices, unused])
    trimesh.Trimesh(vertices, box.faces, process=False).export(tmp_path / "box.ply")
    points = read_cloud(tmp_path / "box.ply")
    assert points.shape == (2048, 3)
    np.testing.assert_allclose(np.abs(points).max(axis=1), 0.5, atol=1e-6)


@pytest.mark.parametrize("mark", [0, -1, 65535, -9999, np.finfo(np.float32).max, np.inf])
def test_places_that_mark_pixels_without_a_measurement_are_dropped(tmp_path, caplog, mark):
    TOLD.clear()
    points = np.random.default_rng(0).random((60, 3), dtype=np.float32)
    np.save(tmp_path / "a.npy", np.concatenate([points, np.full((9, 3), mark, np.float32)]))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy"), points)
    assert "a.npy: 9 of 69 points are" in caplog.text


@pytest.mark.parametrize("place", [(0.1, -0.2, 0.8), (0, 0, 65.535)])
def test_such_marks_are_known_where_a_transform_has_put_them(place, caplog):
    TOLD.clear()
    points = np.random.default_rng(0).random((600, 3))
    marked = np.concatenate([points[:300], np.tile(place, (200, 1)), points[300:]])
    np.testing.assert_array_equal(measured(marked), points)
    assert f"200 of 800 points are at ({place[0]:g}, {place[1]:g}, {place[2]:g})" in caplog.text
    wall = points * [0, 1, 1]
    assert measured(wall) is wall
    twice = np.tile(points, (2, 1))
    assert measured(twice) is twice
    some = np.concatenate([points, np.tile(place, (60, 1))])  # below a tenth
    assert measured(some) is some


def test_a_pcd_drops_such_marks_before_its_viewpoint_moves_them(tmp_path):
    points = np.random.default_rng(0).random((60, 3)).astype("<f4")
    points[:9] = 0
    lines = "SIZE 4 4 4\nTYPE F F F\nVIEWPOINT 1 0 0 1 0 0 0\nPOINTS 60\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(f"FIELDS x y z\n{lines}".encode() + points.tobytes())
    np.testing.assert_allclose(read_cloud(tmp_path / "a.pcd") - [1, 0, 0], points[9:], atol=1e-6)


@pytest.mark.parametrize("name", ["xyz", "points", "Position"])
def test_a_field_of_three_numbers_holds_the_points(tmp_path, name):
    array = np.zeros(3, [("rgb", "u1", (3,)), (name, "f4", (3,))])
    array[name] = POINTS
    np.save(tmp_path / "a.npy", array)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy"), POINTS)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("POINTS 3\n", ""),
        ("DATA binary", "DATA BINARY"),
        ("TYPE F U", "TYPE f u"),
        ("FIELDS", "COLUMNS"),
        (" x y ", " X Y "),
    ],
)
def test_pcd_headers_are_read_in_any_spelling(tmp_path, old, new):
    head = pcd_header("binary").decode()
    assert old in head
    rows = pcd_binary().removeprefix(head.encode())
    (tmp_path / "a.pcd").write_bytes(head.replace(old, new).encode() + rows)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd"), POINTS)


def bad_cases() -> dict[str, tuple[str, bytes, str]]:
    header, npz = pcd_header("ascii"), io.BytesIO()
    np.savez(npz, Points=POINTS)
    return {
        "empty": ("a.xyz", b"", "the file is empty"),
        "garbage text": ("a.xyz", b"hello dear world\n", "could not convert string 'hello'"),
        "ragged": ("a.xyz", b"1 2 3\n1 2\n", "columns changed from 3 to 2 at row 2"),
        "NaN alone": ("a.xyz", b"1 2 nan\n", "holds no point that is finite"),
        "too large for float32": ("a.xyz", b"1 2 1e200\n", "not finite"),
        "npy cut": ("a.npy", npy(POINTS)[:-9], "cannot be read as NPY"),
        "npy of terabytes": ("a.npy", npy_header("(900000000000, 3)"), "takes more memory"),
        "ply garbage": ("a.ply", b"just some words\n", "cannot be read as PLY"),
        "ply x twice": (
            "a.ply",
            ply("ascii").replace(b"float z", b"float X"),
            "property x of vertex twice",
        ),
        "off binary": ("a.off", b"OFF BINARY\n\0\0\0\3\0\0", "is a binary OFF"),
        "ply text cut": ("a.ply", ply("ascii").rpartition(b"\n0")[0], "declares 3 rows of vertex"),
        "ply cut": ("a.ply", ply("binary_little_endian")[:-1], "declares 3 rows of vertex"),
        "off cut": ("a.off", b"OFF\n900000000 0 0\n1 2 3\n", "the file is cut short"),
        "pcd garbage": ("a.pcd", b"just some words\n", "no DATA line"),
        "pcd header": ("a.pcd", b"FIELDS x y z\nDATA ascii\n1 2 3\n", "has no SIZE and no TYPE"),
        "pcd fields": ("a.pcd", header.replace(b" x y ", b" u v "), "no fields x, y and z"),
        "pcd data": ("a.pcd", pcd_header("zip"), "DATA zip is unknown"),
        "pcd sizes": ("a.pcd", header.replace(b"8 4 4 4 2", b"8 4 4 4"), "TYPE and COUNT are not"),
        "pcd type": ("a.pcd", header.replace(b"TYPE F", b"TYPE D"), "TYPE D is unknown"),
        "pcd cut": ("a.pcd", pcd_binary()[:-1], "declares 3 points, but has 2"),
        "pcd of more": ("a.pcd", pcd_binary() + pcd_binary(), "declares 3 points, but has"),
        **{
            f"pose {pose}": (
                "a.pcd",
                pcd_binary().replace(b"0 0 0 1 0 0 0", pose.encode()),
                "is no pose",
            )
            for pose in ("0 0 0 0 0 0 0", "nan 0 0 1 0 0 0", "0 0 1", "0 0 1 0 0 0")
        },
        **{
            f"pcd of no {data}": ("a.pcd", pcd_header(data, 0), "holds no point")
            for data in ("ascii", "binary")
        },
        "two scans": ("a.pts", 2 * b"2\n1 2 3\n4 5 6\n", "several scans: line 4 is a count again"),
        "other names": ("a.npz", npz.getvalue(), "has Points"),
        "compressed cut": ("a.pcd", pcd_compressed()[:-1], "declares 3 points, but has others"),
        "compressed": ("a.pcd", pcd_compressed()[:-1] + b"\xff", "points are damaged"),
        "compressed of nothing": (
            "a.pcd",
            pcd_header("binary_compressed"),
            "declares 3 points, but has none; the file is damaged",
        ),
    }


@pytest.mark.parametrize("case", bad_cases())
def test_bad_file_is_refused_in_one_line_with_its_name(tmp_path, case):
    name, content, message = bad_cases()[case]
    (tmp_path / name).write_bytes(content)
    with refused(message, tmp_path / name):
        read_cloud(tmp_path / name)


def test_pickled_content_is_never_loaded(tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    np.save(tmp_path / "a.npy", np.array([Trap()], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read as NPY"):
        read_cloud(tmp_path / "a.npy")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("head", ["x,y,z,r\n", "//X; Y; Z\r\n", "3 \r", ""])
@pytest.mark.parametrize("ending", ["csv", "asc", "pts", "txt"])
def test_text_may_begin_with_names_or_a_count(tmp_path, head, ending):
    path = tmp_path / f"a.{ending}"
    path.write_text(head + "\n".join(",".join(map(str, row)) for row in POINTS.tolist()))
    np.testing.assert_array_equal(read_cloud(path), POINTS)


def _rows(points, apart=","):
    return "\n".join(apart.join(map(str, row)) for row in np.asarray(points).tolist()) + "\n"


def _of_a_camera(width=16, height=12):
    """Column, row, x, y, z of the pixels of a picture."""
    rng = np.random.default_rng(0)
    v, u = np.indices((height, width)).reshape(2, -1)
    z = 0.7 + 0.05 * rng.random(len(u))
    x, y = (u - width / 2) / (2.5 * width) * z, (v - height / 2) / (2.5 * width) * z
    return np.stack([u, v, x, y, z], axis=1)


SOME = [[0.1, 0.2, 0.3], [0.5, 0.25, 0.125], [0.75, 0.5, 1.5], [1.0, 2.0, 4.0]]
NUMBERED = [[row, *point] for row, point in enumerate(SOME)]
COLOURED = [[200, 100, 50, *point] for point in SOME]
TURNED = [[*point, 9, 8, 7] for point in SOME]
FAR = np.array([512345.67, 5403210.12, 321.5])


@pytest.mark.parametrize(
    ("name", "text"),
    {
        "pandas": ("a.csv", ",x,y,z\n" + _rows(NUMBERED)),
        "any order": ("a.csv", "Z;id;Y;X\n" + _rows([[c, 7, b, a] for a, b, c in SOME], ";")),
        "words": ("a.csv", "l,x,y,z\n" + "".join(f"chair,{_rows([point])}" for point in SOME)),
        "millimetres": ("a.csv", "x [mm],y [mm],z [mm]\n" + _rows(np.multiply(SOME, 1000))),
        "words of units": (
            "a.csv",
            "X Coordinate (millimeters),y_coord [millimeters],z (millimetres)\n"
            + _rows(np.multiply(SOME, 1000)),
        ),
        "spaces": ("a.txt", "Z [m] X [m] Y [m]\n" + _rows([[c, a, b] for a, b, c in SOME], " ")),
        "cm": ("a.csv", "x_cm\ty_cm\tz_cm\n" + _rows(np.multiply(SOME, 100), "\t")),
        "comment": ("a.xyz", "# r g b x y z\n" + _rows(COLOURED, " ")),
        "prose": ("a.xyz", "# x and y in metres\n# Columns: r g b x y z\n" + _rows(COLOURED, " ")),
        "CloudCompare": ("a.asc", "//X,Y,Z,R,G,B\n" + _rows(TURNED)),
        "ParaView": ("a.csv", '"n:0","Points:0","Points:1","Points:2"\n' + _rows(NUMBERED)),
        "E57": ("a.csv", "n,cartesianX,cartesianY,cartesianZ\n" + _rows(NUMBERED)),
        "px": ("a.csv", "nx,ny,nz,px,py,pz\n" + _rows(COLOURED)),
        "PTS": ("a.pts", "4\n" + _rows(TURNED, " ")),
        "intensity": ("a.xyz", _rows([[*point, 0.5] for point in SOME], " ")),
        "trailing": ("a.csv", _rows(SOME).replace("\n", ",\n")),
        "mark": ("a.csv", "\ufeffx,y,z\n" + _rows(SOME)),
        "quoted": ("a.csv", re.sub(r"([^,\n]+)", r'"\1"', "X,Y,Z\n" + _rows(SOME))),
        "slash": ("a.csv", "X/mm,Y/mm,Z/mm\n" + _rows(np.multiply(SOME, 1000))),
        "index": ("a.csv", "Unnamed: 0,x,y,z\n" + _rows(NUMBERED)),
        "Excel": ("a.csv", "sep=;\nX;Y;Z\n" + _rows(SOME, ";")),
        "tabs of Excel": ("a.csv", '"sep=\t"\nX\tY\tZ\n' + _rows(SOME, "\t")),
        "empty rows": ("a.csv", '\n,,\n"",\nX,Y,Z\n' + _rows(SOME)),
        "Matlab": ("a.txt", _rows(SOME, " ").replace("\n", ";\n")),
        "NaN": ("a.csv", "x,y,z\n" + _rows(SOME) + ",,\nNA,NA,NA\n1,,2\n"),
        "NULL": ("a.csv", "x,y,z\n" + _rows(SOME) + "NULL,NULL,NULL\n"),
        "NaN of Windows": ("a.xyz", 2 * "-nan(ind) 1.#QNAN -1.#IND00\n" + _rows(SOME, " ")),
        "mixed": ("a.xyz", _rows([[*point, 7] for point in SOME], " ").replace(" 7", "\t7 8")),
        "end of file": ("a.xyz", _rows(SOME, " ") + "\0\x1a"),
        "normals": ("a.xyz", _rows([[*row, 0.6, 0.8, 0] for row in SOME], " ")),
    }.values(),
)
def test_columns_are_found_by_name(tmp_path, name, text):
    (tmp_path / name).write_text(text, encoding="utf-8")
    np.testing.assert_allclose(read_cloud(tmp_path / name), SOME, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_rows(NUMBERED), "counts the rows"),
        ("x,y,z\n" + _rows(NUMBERED), "names 3 columns, and its rows have 4"),
        ("0,1,2\n" + _rows(SOME), "counts the columns"),
        (",0,1,2\n" + _rows(NUMBERED), "could not convert string ''"),
        ("a,b,c\n" + _rows(SOME), "names no columns x, y and z"),
        ("x,y,z\nft,ft,ft\n" + _rows(SOME), "the unit of column .* is unknown"),
        ("x,y,z\nmm,mm,m\n" + _rows(SOME), "in several units"),
        ("x,x,y,z\n" + _rows(NUMBERED), "names a column twice"),
        ("x [ft],y [ft],z [ft]\n" + _rows(SOME), r"the unit of column 'x \[ft\]' is unknown"),
        ("x [mm],y,z\n" + _rows(SOME), "in several units"),
        ("# units: mm\nx [m],y [m],z [m]\n" + _rows(SOME), "the unit mm, and its columns another"),
        ("# unit: m\n# x[mm] y[mm] z[mm]\n" + _rows(COLOURED), "the unit m, and its columns"),
        ("# all x, y, z and the like\n" + _rows(COLOURED), "its comment names columns"),
        ("5\n" + _rows(SOME), "declares 5 points, but has 4"),
        ("3\n" + _rows(SOME), "declares 3 points, but has 4"),
        (_rows(SOME).replace(",0.2", ",,0.2"), "could not convert string ''"),
        (_rows([[row * 0.0333, *point] for row, point in enumerate(SOME * 5)]), "or is a time"),
        (_rows([[-row / (30 + row % 2), *p] for row, p in enumerate(SOME * 5)]), "or is a time"),
        (_rows([[1.7e9 + row // 5, *p] for row, p in enumerate(SOME * 5)]), "is a time, by its"),
        (_rows(_of_a_camera()), "are pixels"),
        (_rows(_of_a_camera()[:, [1, 0, 2, 3, 4]]), "are pixels"),
        (_rows(np.insert(_of_a_camera(), 2, 700, axis=1)), "are pixels"),
        (_rows([[row * 37 % 256, *point] for row, point in enumerate(SOME)]), "whole numbers"),
        (_rows([[3, *point] for point in SOME]), "whole numbers"),
        (_rows([[*row[:3], *(0.1 + np.array(row[3:]))] for row in COLOURED]), "are colours"),
        ("x,y,z [mm]\n1,2,3\n", r"several units: .*; give all one, as x \[mm\]"),
        ("51 377.5\t51 736.1\t9 640.0\n" * 4, "numbers with spaces in them"),
        ("137,7,173,6,964,0\n131,5,92,9,1083,5\n491,2,389,4,972,1\n", "has decimal commas"),
        ("0,1377,0,1736,0,9640,7\n0,1315,0,0929,1,0835,7\n", "has decimal commas"),
        (_rows((SOME + FAR).astype(np.float32)), "single precision rounds it to 0.64 m"),
    ],
)
def test_columns_that_are_unclear_are_refused(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with refused(message, tmp_path / "a.csv"):
        read_cloud(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("width", "height", "gap"),
    [
        *((160, 120, gap) for gap in (None, 0.0, np.nan, np.inf, -1.0)),
        (640, 480, 0.0),
        # 200 of these, evenly spaced, would be one column of the picture.
        *((80, 600, None), (160, 1200, None)),
        (40, 597, None),
    ],
)
def test_pixels_before_x_y_z_are_refused(tmp_path, width, height, gap):
    rows = _of_a_camera(width, height)
    if gap is not None:
        rows[np.random.default_rng(1).random(len(rows)) < 0.05, 2:] = gap
        rows[: 3 * width, 2:] = gap
    depth = np.insert(rows, 2, rows[:, 4], axis=1)
    steps = np.insert(rows, 2, np.rint(1000 * np.nan_to_num(rows[:, 4], posinf=0)), axis=1)
    for table in (rows, rows[:, [1, 0, 2, 3, 4]], depth, steps, np.insert(rows, 5, 7, axis=1)):
        np.save(tmp_path / "a.npy", table.astype(np.float32))
        with refused("its first two columns are pixels", tmp_path / "a.npy"):
            read_cloud(tmp_path / "a.npy")


@pytest.mark.parametrize(("x", "more"), [(0, 1), (0, 3), (1, 3), (-2, 4)])
def test_a_wall_with_its_intensities_or_normals_is_read(tmp_path, x, more):
    rng = np.random.default_rng(0)
    rows = np.hstack([np.full((300, 1), x), rng.normal(size=(300, 2)), rng.random((300, more))])
    np.save(tmp_path / "a.npy", rows)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.npy"), rows[:, :3], rtol=1e-6)


@pytest.mark.parametrize("gap", [0.0, np.nan, np.inf])
def test_columns_that_are_unclear_are_refused_if_the_first_points_are_missing(tmp_path, gap):
    rng = np.random.default_rng(0)
    points = rng.random((4000, 3))
    points[:1000] = gap
    time, colour = rng.integers(2e8, 3e8, (4000, 1)), rng.integers(0, 256, (4000, 3))
    for table, message in (
        (np.hstack([time, points]), "first column is a time"),
        (np.hstack([colour[:, :1], points]), "first column holds whole numbers"),
        (np.hstack([colour, points]), "first three columns are colours"),
    ):
        np.save(tmp_path / "a.npy", table)
        with refused(message, tmp_path / "a.npy"):
            read_cloud(tmp_path / "a.npy")


@pytest.mark.parametrize("digits", [3, 9])
def test_normals_before_the_points_are_refused_and_a_ball_is_read(tmp_path, digits):
    rng = np.random.default_rng(0)
    points, normals = rng.random((900, 3)) / 5, rng.normal(size=(900, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).round(digits)
    for more in (points, np.hstack([points, normals])):
        np.save(tmp_path / "a.npy", np.hstack([normals, more]))
        with refused("first three columns are normals", tmp_path / "a.npy"):
            read_cloud(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.hstack([normals, normals]))  # of radius 1
    np.testing.assert_allclose(read_cloud(tmp_path / "a.npy"), normals, rtol=1e-5)


@pytest.mark.parametrize("rows", [2, 37, 400])
@pytest.mark.parametrize("step", [0.1, -0.002])
def test_times_of_several_rows_each_are_refused_and_sorted_points_read(tmp_path, rows, step):
    points = np.random.default_rng(0).random((2000, 3)) / 5
    times = step * (np.arange(2000) // rows)
    for table in (points, points.round(3), points * [1, 1, 0] + [0, 0, 0.3]):
        np.save(tmp_path / "a.npy", np.column_stack([times, table]))
        with refused("is a time", tmp_path / "a.npy"):
            read_cloud(tmp_path / "a.npy")
    y, x = np.indices((2000 // rows, rows)).reshape(2, -1) * abs(step)
    for table in (np.unique(points.round(2), axis=0), np.column_stack([y, x, np.hypot(x, y)])):
        for way in (table, table[::-1]):
            np.save(tmp_path / "a.npy", np.column_stack([way, points[: len(way), 0]]))
            np.testing.assert_allclose(read_cloud(tmp_path / "a.npy"), way, rtol=1e-6)


@pytest.mark.parametrize("lines", [slice(None), [0, 1, 3, 4, 5, 8, 9, 11]])
@pytest.mark.parametrize("across", [2, 3, 50])
@pytest.mark.parametrize("pitch", [0.004, -0.02])
def test_a_raster_that_goes_to_and_fro_is_read(tmp_path, lines, across, pitch):
    rng = np.random.default_rng(0)
    x, y = np.indices((12, across)) * np.array([pitch, 0.003])[:, None, None]
    y[1::2] = y[1::2, ::-1]
    x, y = x[lines].ravel(), y[lines].ravel()
    points = np.column_stack([x, y, 0.7 + 0.01 * rng.random(len(x))])
    np.save(tmp_path / "a.npy", np.column_stack([points, rng.random(len(x))]).astype(np.float32))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.npy"), points, rtol=1e-6)


def _voxels(step, shift):
    """A ball of voxels, sorted by x alone."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(1500, 3))
    ball *= 9 / np.linalg.norm(ball, axis=1, keepdims=True)
    ball = rng.permutation(np.unique(np.rint(ball), axis=0))
    return ball[np.argsort(ball[:, 0], kind="stable")] * step + shift


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("step", [0.0033, 0.01, 0.5, 1])
@pytest.mark.parametrize("more", ["random", "label", "normals", "one"])
def test_voxels_sorted_by_x_alone_are_read(tmp_path, way, step, more):
    voxels = _voxels(step, 0 if step == 1 else [0.1234, -0.0777, 0.5001])[::way]
    rng = np.random.default_rng(1)
    more = {
        "random": rng.random(len(voxels)),
        "label": rng.integers(5, size=len(voxels)) + (0.5 if step == 1 else 0),
        "normals": voxels / np.linalg.norm(voxels, axis=1, keepdims=True).clip(1e-9),
        "one": np.full(len(voxels), 0.7),
    }[more]
    np.savetxt(tmp_path / "a.xyz", np.column_stack([voxels, more]), fmt="%.5f")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.xyz"), voxels, atol=1e-5)


@pytest.mark.parametrize("step", [0.001, 0.01, 0.1, 1])
def test_times_before_rounded_points_or_pixels_are_refused(tmp_path, step):
    """Also if the points lie on a grid as fine as the steps of the time."""
    rng = np.random.default_rng(0)
    times = step * np.repeat(np.arange(40), 50)
    points, pixels = (rng.integers(low, 200, size=(2000, 3)) for low in (-200, 0))
    depth = rng.random((2000, 1))
    tables = (points * 0.001, points, points * step, np.hstack([pixels[:, :2], depth]))
    for table in tables:
        np.save(tmp_path / "a.npy", np.column_stack([times, table]))
        with refused("is a time|holds whole numbers", tmp_path / "a.npy"):
            read_cloud(tmp_path / "a.npy")


def test_a_grid_of_whole_steps_with_its_normals_is_a_cloud(tmp_path):
    y, x = np.indices((40, 50)).reshape(2, -1) - 20.0
    normals = np.stack([-x / 50, -y / 50, np.ones(len(x))], axis=1)  # of a bowl
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.stack([x, y, (x**2 + y**2) / 100], axis=1)
    np.save(tmp_path / "a.npy", np.hstack([points, normals]))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.npy"), points, rtol=1e-6)


def _far_files(points):
    struct_array = np.rec.fromarrays([points[:, 2], *points[:, :2].T], names="z,x,y")
    lines = "".join(f"property double {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{lines}"
    pcd = f"FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS {len(points)}\nDATA binary\n"
    return {
        "a.xyz": _rows(points, " ").encode(),
        "a.npy": npy(points),
        "b.npy": npy(np.asarray(struct_array)),
        "a.ply": f"{header}end_header\n".encode() + points.tobytes(),
        "a.pcd": pcd.encode() + points.tobytes(),
    }


def test_points_far_from_the_origin_keep_their_shape(tmp_path, caplog):
    cloud = np.random.default_rng(0).random((1000, 3))
    for name, content in _far_files(cloud + FAR).items():
        TOLD.clear()
        caplog.clear()
        (tmp_path / name).write_bytes(content)
        points = read_cloud(tmp_path / name)
        assert points.dtype == np.float32
        np.testing.assert_allclose(np.ptp(points, axis=0), np.ptp(cloud, axis=0), atol=1e-4)
        np.testing.assert_allclose(points - points[0], cloud - cloud[0], atol=1e-4)
        assert name in caplog.text
        assert "is moved by -512346 -5403211 0" in caplog.text
    (tmp_path / "flat").mkdir()
    np.savez(tmp_path / "far.npz", points=(cloud + FAR)[None])
    convert(tmp_path / "far.npz", tmp_path / "flat", "ply")
    (points,) = read_clouds(tmp_path / "flat")[0].clouds
    np.testing.assert_allclose(points - points[0], cloud - cloud[0], atol=1e-4)
    near = read_cloud(tmp_path / "a.npy") * 0 + cloud.astype(np.float32)
    np.testing.assert_array_equal(single(near), near)


@pytest.mark.parametrize(
    "text",
    [
        "0,5095, 0,8604, 0,2153\n",
        "0,5, -0,25, 3, 0,1\n",
        "0,5095,0,8604,0,2153\n0,8589,0,0495,0,4387\n",
        "-0,5,0,02,1,7\n",
        "-98,1,40,5,608,2,255,9,10\n" * 4,
        "1 2 3\n0,5 0,25 1\n",
        "1;2;3\n0,5;0,25;1\n",
        "0,5\t0,25\t1\n",
        "x y z\n0,10 0,25 -3",
        "x;y;z\n0,10;0,25;-3",
        "x; y; z\n0,10; 0,25; -3",
    ],
)
@pytest.mark.parametrize("ending", ["txt", "csv"])
def test_decimal_commas_beside_commas_are_refused(tmp_path, text, ending):
    path = tmp_path / f"a.{ending}"
    path.write_text(text)
    with refused("has decimal commas: .*; write points", path):
        read_cloud(path)


@pytest.mark.parametrize(
    "text",
    [
        "1,2,3\n40,50,60\n",
        "1, 2, 3\n",
        "1,20,3,255,0,10\n0,0,0,1,2,3",
        "1,2,3,8,7,6,0.5\n" * 4,  # with a point, so that no comma is one
    ],
)
def test_whole_numbers_between_commas_are_columns(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text)
    wanted = [[float(word) for word in row.split(",")[:3]] for row in text.split("\n") if row]
    assert read_cloud(path).tolist() == wanted


@pytest.mark.parametrize("rows", [3, 4, 6, 16])
@pytest.mark.parametrize("ending", ["npy", "npz", "txt"])
def test_transposed_arrays_are_refused(tmp_path, rows, ending):
    path = tmp_path / f"a.{ending}"
    array = np.random.default_rng(0).random((rows, 100))
    if ending == "npy":
        np.save(path, array)
    elif ending == "npz":
        np.savez(path, points=array)
    else:
        np.savetxt(path, array)
    with refused(rf"shape \[{rows}, 100\]; transpose it", path):
        read_cloud(path)


@pytest.mark.parametrize("columns", [3, 4, 6])
def test_transposed_hdf5_is_refused(tmp_path, columns):
    import h5py

    path = tmp_path / "ply_data_train0.h5"
    with h5py.File(path, "w") as file:
        file["data"] = np.zeros((2, columns, 2048), "f4")
        file["label"] = np.zeros((2, 1), "u1")
    with refused(rf"shape \[2, {columns}, 2048\]; transpose it", path):
        read_clouds(path)


@pytest.mark.parametrize("mark", [np.nan, np.inf, -np.inf, 0.0])
@pytest.mark.parametrize("ending", ["npy", "xyz", "ply", "pcd", "npz", "h5"])
def test_pixels_without_a_measurement_are_dropped(tmp_path, caplog, mark, ending):
    import h5py

    TOLD.clear()
    whole = np.random.default_rng(0).random((6, 5, 3)).astype(np.float32) + 0.1
    whole[1, ::2] = mark
    whole[4, 1, 2] = mark
    kept = whole[np.isfinite(whole).all(axis=2) & whole.any(axis=2)]
    flat = whole.reshape(-1, 3)
    path = tmp_path / f"a.{ending}"
    if ending == "npy":
        np.save(path, flat)
    elif ending == "npz":
        np.savez(path, points=flat[None])
    elif ending == "h5":
        path = tmp_path / "ply_data_train0.h5"
        with h5py.File(path, "w") as file:
            file["data"], file["label"] = flat[None], np.zeros((1, 1), "u1")
    elif ending == "pcd":
        head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS {len(flat)}\nDATA binary\n"
        path.write_bytes(head.encode() + flat.tobytes())
    elif ending == "ply":
        path.write_bytes(ply_bytes(flat))
    else:
        np.savetxt(path, flat)
    if ending in ("npz", "h5"):
        (points,) = read_clouds(path)[0].clouds
        points = points[:, [0, 2, 1]] * [1, 1, -1] if ending == "h5" else points
    else:
        points = read_cloud(path)
    np.testing.assert_allclose(points, kept, rtol=1e-6)
    assert "marks a pixel without a measurement" in caplog.text


def test_raw_numbers_of_las_are_refused(tmp_path):
    names = [(axis, "<i4") for axis in "XYZ"] + [("intensity", "<u2"), ("point_source_id", "<u2")]
    np.save(tmp_path / "a.npy", np.ones(5, names))
    with refused(r"raw numbers of a LAS file, without its scale; save las\.xyz", "a.npy"):
        read_cloud(tmp_path / "a.npy")


def test_an_array_of_three_axes_may_be_many_clouds_and_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((6, 5, 3)))
    with refused(r"shape \[6, 5, 3\]; of one organised cloud save points\.reshape\(-1, 3\)"):
        read_cloud(tmp_path / "a.npy")


def test_one_point_at_the_origin_is_a_point():
    cloud = np.random.default_rng(0).random((500, 3))
    cloud[3] = 0
    assert measured(cloud) is cloud
    cloud[4] = 0  # two of 500 are below one in a hundred
    assert measured(cloud) is cloud
    assert len(measured(np.zeros((3, 3)))) == 3


def test_no_place_of_a_part_is_taken_for_a_pixel_without_a_measurement():
    corners = trimesh.creation.box((10, 10, 10)).triangles.reshape(-1, 3) + 5  # of no merged mesh
    grid = np.tile(np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3), (4, 1))
    line = np.tile(np.linspace(0, 1, 50)[:, None], (2, 3))
    raster = np.stack([*np.indices((30, 40)).reshape(2, -1), np.arange(1200) % 7], axis=1) / 1000
    for whole in (corners, grid, line, raster):
        assert measured(whole) is whole
    seen = np.random.default_rng(0).normal(size=(2000, 3))
    for times in (1, 8):  # points may be repeated up to a number
        for count in (9, 10, 600):
            marked = np.tile(np.concatenate([seen, np.zeros((count, 3))]), (times, 1))
            assert len(measured(marked)) == times * (2000 + count * (count < 10))


TURN = (
    ("0 0 0 1 0 0 0", lambda p: p),
    ("0 0 0 -2 0 0 0", lambda p: p),
    ("1 2 3 0.70710678 0.70710678 0 0", lambda p: p[:, [0, 2, 1]] * [1, -1, 1] + [1, 2, 3]),
    ("0 0 1 0.5 0 0 0.5", lambda p: p[:, [1, 0, 2]] * [-1, 1, 1] + [0, 0, 1]),
)


@pytest.mark.parametrize(("pose", "move"), TURN)
def test_a_pcd_is_placed_by_its_viewpoint(tmp_path, caplog, pose, move):
    TOLD.clear()
    (tmp_path / "a.pcd").write_bytes(pcd_binary().replace(b"0 0 0 1 0 0 0", pose.encode()))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.pcd"), move(POINTS), atol=1e-5)
    assert ("VIEWPOINT" in caplog.text) == (move(POINTS) is not POINTS)


@pytest.mark.parametrize("codec", ["utf-16", "utf-16-be", "utf-8-sig"])
def test_text_of_any_unicode_is_read(tmp_path, codec):
    path = tmp_path / "a.csv"
    mark = "\ufeff" * (codec == "utf-16-be")
    path.write_text(f"{mark}x;y;z\r\n" + _rows(SOME, ";"), encoding=codec)
    np.testing.assert_allclose(read_cloud(path), SOME)


@pytest.mark.parametrize(
    ("name", "content"),
    {
        "empty body": ("a.csv", b"x,y,z\n# nothing\n"),
        "overflow": ("a.xyz", b"1e300 2 3\n-1e300 2 3\n"),
        "far": ("a.xyz", b"1e38 2 3\n-3e38 2 3\n1 2 3\n"),
        "ply words": ("a.ply", ply("ascii") + b"x y\n"),
        "infinite": ("a.npy", npy(np.full((4, 3), np.inf))),
        "nan": ("a.npy", npy(np.full((4, 3), np.nan, np.float32))),
        "half": ("a.npy", npy(np.full((4, 3), 6e4, np.float16))),
    }.values(),
)
def test_warnings_of_numpy_reach_nobody(tmp_path, name, content, recwarn):
    (tmp_path / name).write_bytes(content)
    with contextlib.suppress(InputError):
        read_cloud(tmp_path / name)
    assert [str(warning.message) for warning in recwarn] == []


FAULTS = {
    "t_commaspace.txt": "has decimal commas",
    "n_T.npy": r"shape \[3, 100\]; transpose it",
    "c_zero.pcd": "holds no point",
    "t_pts2.pts": "several scans: line 102",
    "y_caps.ply": 200,
    "y_half.ply": 200,
    "c_vp.pcd": 200,
    "zeros.ply": 1024,
}


@pytest.mark.data
@pytest.mark.parametrize("name", FAULTS)
def test_clouds_of_public_reports_are_read_or_refused(shared_data, name):
    wanted, path = FAULTS[name], shared_data / "faults" / name
    if isinstance(wanted, str):
        with refused(wanted, path):
            read_cloud(path)
        return
    points = read_cloud(path)
    assert points.shape == (wanted, 3)
    assert points.any(axis=1).all()
    if name == "c_vp.pcd":  # turned by 90° about x and moved by 1 2 3
        assert (points > [1, 1, 3]).all() and (points < [2, 2, 4]).all()


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_cloud(tmp_path / "a.npy")
    (tmp_path / "a.docx").write_bytes(b"x")
    with pytest.raises(InputError, match="not a point cloud file; known are"):
        read_cloud(tmp_path / "a.docx")


def test_depth_images_in_the_place_of_clouds_get_the_way_to_clouds(tmp_path):
    image = tmp_path / "shots" / "depth" / "000000.png"
    image.parent.mkdir(parents=True)
    image.write_bytes(b"x")
    np.save(tmp_path / "000000.npy", np.ones((48, 129), np.float32))
    for path, read in (
        (image, read_cloud),
        (tmp_path / "000000.npy", read_cloud),
        (tmp_path / "shots", lambda path: list_clouds([path])),
        (tmp_path / "shots", detect),
    ):
        with pytest.raises(
            InputError, match="qs3 segment IMAGE_OR_FOLDER --intrinsics CAMERA"
        ) as error:
            read(path)
        assert str(path) in str(error.value)
    rng = np.random.default_rng(0)
    for kind in (np.float32, np.uint16):  # of a small sensor, with pixels that saw nothing
        image = rng.normal(700, 2, (60, 80)) + np.arange(80) - 100 * (np.arange(80) > 40)
        image = np.where(rng.random((60, 80)) < 0.1, 0, image).astype(kind)
        image[:, :8] = 0
        for saved in (image, image[..., None]):
            np.save(tmp_path / "000000.npy", saved)
            with refused("qs3 segment IMAGE_OR_FOLDER"):
                read_cloud(tmp_path / "000000.npy")
    features = rng.normal(size=(48, 64)), rng.random((48, 40)), rng.random((48, 64)) > 0.9
    features += np.full((48, 20), 0.7), rng.normal(1, 0.01, (48, 32))
    for more in features:
        for shape in ([1, 1, 1], [0, 1, 1], [1, 1, 0]):  # flat ones too
            np.save(tmp_path / "000000.npy", np.hstack([rng.random((48, 3)) * shape, more]))
            assert read_cloud(tmp_path / "000000.npy").shape == (48, 3)
    np.save(tmp_path / "000000.npy", np.ones((3, 2048), np.float32))
    with pytest.raises(InputError, match="transpose it"):
        read_cloud(tmp_path / "000000.npy")
    (tmp_path / "meshes").mkdir()
    for name in ("texture.png", "chair.obj"):
        (tmp_path / "meshes" / name).write_bytes(b"x")
    assert not depth_hint(tmp_path / "meshes")


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian", "binary_little_endian"])
def test_ply_with_other_columns_and_elements_around_its_vertices(tmp_path, form):
    lines = (
        "comment made by hand\nelement camera 1\nproperty double focal\n"
        "element vertex 2\nproperty uchar red\nproperty double z\nproperty float x\n"
        "property short y\nelement face 0\nproperty list uchar int vertex_indices"
    )
    order = ">" if "big" in form else "<"
    body = struct.pack(f"{order}dBdfhBdfh", 1.5, 9, 3, 1, 2, 8, 6, 4, 5)
    if form == "ascii":
        body = b"1.5\n9 3 1 2\n8 6 4 5\n"
    (tmp_path / "a.ply").write_bytes(
        f"ply\nformat {form} 1.0\n{lines}\nend_header\n".encode() + body
    )
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply"), [[1, 2, 3], [4, 5, 6]])
