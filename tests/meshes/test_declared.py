"""Files as the formats' specifications allow them: the right area and size, or a refusal."""

import struct
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import TOLD
from qs3.meshes import load_mesh, text_formats

from ..clouds.hostile import refused

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
HIGH = TRIANGLE.replace(" 0\n", " 5\n")
UV = "vt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\nvn 0 0 1\nvn 0 0 1\n"
U_SHAPE = [(0, 0), (4, 0), (4, 4), (3, 4), (3, 1), (1, 1), (1, 4), (0, 4)]
U_ROWS = [f"{x} {y} 0\n" for x, y in U_SHAPE]
U_OBJ = "".join(f"v {row}" for row in U_ROWS)
CORNERS = [f"{x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
CUBE = "\n".join(CORNERS) + "\n"
SIDES = ["4 0 1 3 2", "4 4 6 7 5", "4 0 4 5 1", "4 2 3 7 6", "4 0 2 6 4", "4 1 5 7 3"]
CUBE_OFF = f"OFF\n8 6 0\n{CUBE}" + "\n".join(SIDES)
PLY = (
    "ply\nformat {}\ncomment a\nelement vertex {}\nproperty {} x\nproperty {} y\nproperty {} z\n"
    "element face {}\nproperty list {} {} vertex_{}\nend_header\n"
)


def ply(order: str, vertices, faces, number="float", length="uchar", index="int", name="indices"):
    head = PLY.format(order, len(vertices), *[number] * 3, len(faces), length, index, name)
    if order.startswith("ascii"):
        rows = [" ".join(map(str, row)) for row in vertices]
        rows += [" ".join(map(str, (len(row), *row))) for row in faces]
        return (head + "\n".join(rows) + "\n").encode()
    mark = ">" if "big" in order else "<"
    codes = {"float": "f", "double": "d", "uchar": "B", "int": "i", "uint": "I", "ushort": "H"}
    body = b"".join(struct.pack(f"{mark}3{codes[number]}", *row) for row in vertices)
    for row in faces:
        body += struct.pack(f"{mark}{codes[length]}{len(row)}{codes[index]}", len(row), *row)
    return head.encode() + body


SQUARES = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 2)]
SQUARE_ROWS = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 2\n"
MIXED = [(0, 1, 2, 3), (0, 1, 4), (3, 2, 1, 0)]  # 1 + 1 + 1
LITTLE, BIG = "binary_little_endian 1.0", "binary_big_endian 1.0"
STRIPS = (
    PLY.format("ascii 1.0", 5, *["double"] * 3, 1, "int", "int", "indices")
    .replace("element face", "element tristrips")
    .replace("element vertex", "element camera 1\nproperty float f\nelement vertex")
)
SIDE = (
    "facet normal 0 0 1\nouter loop\nvertex 0 0 {0}\nvertex 1 0 {0}\nvertex 0 1 {0}\nendloop\n"
    "endfacet\n"
)


def stl(announced: int, present: int, head=b"", tail=b"") -> bytes:
    rows = [
        bytes(12) + np.array([[0, 0, z], [1, 0, z], [0, 1, z]], "<f4").tobytes() + bytes(2)
        for z in range(present)
    ]
    return head.ljust(80, b"\0") + struct.pack("<I", announced) + b"".join(rows) + tail


FLAT, UNIT = (1, 1, 0), (1, 1, 1)
READ = {
    "relative.obj": (f"{TRIANGLE}f -3 -2 -1\n{HIGH}f -3 -2 -1\n", 1, (1, 1, 5)),
    "uv.obj": (
        f"{TRIANGLE}{UV}f -3/-3/-3 -2/-2/-2 -1/-1/-1\n{HIGH}{UV}f -3/-3 -2/-2 -1/-1\n",
        1,
        (1, 1, 5),
    ),
    "bom.obj": (f"\ufeff{TRIANGLE}f 1 2 3\n".replace("\n", "\r\n"), 0.5, FLAT),
    "long.obj": (f"{TRIANGLE}f 1 2 3" + 200_000 * "\\\n" + "\n", 0.5, FLAT),  # took minutes
    "last.obj": (f"{TRIANGLE}f 3 2 1\nf 1 2 3 \\", 1, FLAT),
    "last_number.obj": (f"{TRIANGLE}f 1 2 \\\n 3\\\n", 0.5, FLAT),
    "continued.obj": (f"{TRIANGLE}f 1//1 \\\n 2//1 \\\r\n 3//1 # a face\n", 0.5, FLAT),
    "columns.obj": (
        "# \xe4\no a\nv 0 0 0 1 .5 .5\nv 1e0 0 0 1\nv 0 1.0E+0 0 1 0 0 1\nl 1 2\np 1\nf 1 2 3 # x",
        0.5,
        FLAT,
    ),
    "u.obj": (f"{U_OBJ}f 1 2 3 4 5 6 7 8\n", 10, (4, 4, 0)),
    "turned.obj": (f"{U_OBJ}f 8 7 6 5 4 3 2 1\n", 10, (4, 4, 0)),
    "u.off": (f"OFF\n8 1 0\n{''.join(U_ROWS)}8 0 1 2 3 4 5 6 7\n", 10, (4, 4, 0)),
    "u.ply": (ply("ascii 1.0", [(x, y, 0) for x, y in U_SHAPE], [range(8)]), 10, (4, 4, 0)),
    "lower.off": (CUBE_OFF.replace("OFF\n", "off "), 6, UNIT),
    "bom.off": (f"\ufeff# Gr\xf6\xdfe\n{CUBE_OFF}".replace("\n4 ", "\n# b\n4 "), 6, UNIT),
    "latin.off": (f"# Gr\xf6\xdfe\n{CUBE_OFF}".encode("latin-1"), 6, UNIT),
    "edges.off": (f"{CUBE_OFF}\n2 0 1\n1 0".replace("8 6", "8 8"), 6, UNIT),
    "colours.off": (
        f"COFF\n8 6 0\n{CUBE}".replace("\n", " 9 9 9 9\n").replace(
            "OFF 9 9 9 9\n8 6 0 9 9 9 9", "OFF\n8 6 0"
        )
        + " 9 9 9\n".join(SIDES),
        6,
        UNIT,
    ),
    "lower_normals.off": ("noff\n3 1\n0 0 0 0 0 1\n1 0 0 0 0 1\n0 1 0 0 0 1\n3 0 1 2", 0.5, FLAT),
    "no_strips.ply": (
        ply(LITTLE, SQUARES, MIXED).replace(
            b"end_header", b"element tristrips 0\nproperty list uchar int indices\nend_header"
        ),
        3,
        (1, 1, 2),
    ),
    "mixed.ply": (ply(LITTLE, SQUARES, MIXED).replace(b"ply", b"PLY", 1), 3, (1, 1, 2)),
    "big.ply": (ply(BIG, SQUARES, MIXED, "double", "int", "uint", "index"), 3, (1, 1, 2)),
    "short.ply": (ply(LITTLE, SQUARES, MIXED, "float", "ushort", "ushort") + b"\n", 3, (1, 1, 2)),
    "tail.stl": (stl(2, 2, tail=b"made by hand"), 1, UNIT),
    "solid.stl": (stl(2, 2, b"solid of facets", b"\0\0"), 1, UNIT),
    "one_line.stl": (f"solid facet a {SIDE.format(0)} endsolid".replace("\n", " "), 0.5, FLAT),
    "named.stl": (f"solid a facet normal\n{SIDE.format(0)}endsolid facet normal", 0.5, FLAT),
    "head.stl": (stl(2, 2, b"solid a\nfacet normal 0 0 1"), 1, UNIT),
    "returns.stl": (f"solid\n{SIDE.format(0)}endsolid".replace("\n", "\r"), 0.5, FLAT),
    "upper.stl": (
        f"SOLID vertex 1\n{SIDE.format(0)}ENDSOLID\nsolid b\n{SIDE.format(3)}endsolid b".upper(),
        1,
        (1, 1, 3),
    ),
    **{
        f"end_{number}.stl": (f"solid a\n{SIDE.format(0)}{end}", 0.5, FLAT)
        for number, end in enumerate(
            (
                "end solid a\n",
                "END  SOLID",
                "endsolid a\n\0\0\0\0",
                "endsolid\x1a\r\n",
                "end\nsolid",
            )
        )
    },
    "no_normal.stl": (
        f"solid\n{SIDE.format(0)}{SIDE.format(3).replace('normal 0 0 1', '')}endsolid",
        1,
        (1, 1, 3),
    ),
    "spaces.stl": (
        f"solid a\n{SIDE.format(0)}endsolid".replace("endl", "end l").replace("endf", "end f"),
        0.5,
        FLAT,
    ),
    "utf16.stl": (f"solid a\n{SIDE.format(0)}endsolid".encode("utf-16"), 0.5, FLAT),
    "utf16.obj": (f"\ufeff{TRIANGLE}f 1 2 3\n".encode("utf-16-be"), 0.5, FLAT),
    "utf16.off": (CUBE_OFF.encode("utf-16"), 6, UNIT),
    "lines.obj": (f"{TRIANGLE}f 1 2 3\nf 1 2\nf 3\nf 1 2 3\n", 1, FLAT),
    "tab.obj": (f"{TRIANGLE}f\t1 2 3\n", 0.5, FLAT),
    "w.obj": (f"{TRIANGLE}v 0 0 0 1\nf 1 2 3\n", 0.5, FLAT),
    "headless.off": (CUBE_OFF.replace("OFF\n", "# made by hand\n"), 6, UNIT),
    "lines.ply": (ply(LITTLE, SQUARES, [*MIXED, (0, 1)]), 3, (1, 1, 2)),
    "strips.ply": (f"{STRIPS}7\n" + SQUARE_ROWS + "8 0 1 3 2 -1 0 1 4\n", 2, (1, 1, 2)),
    "capitals.ply": (
        ply(LITTLE, SQUARES, MIXED)
        .partition(b"end_header")[0]
        .replace(b"float", b"Float", 1)
        .replace(b"face", b"FACE")
        .replace(b" x\n", b" X\n")
        .replace(b"property", b"Property", 2)
        .replace(b"vertex_indices", b"Vertex_Indices")
        .replace(b"element vertex", b"ELEMENT Vertex")
        .replace(b"binary_little_endian", b"Binary_Little_Endian")
        + b"END_HEADER"
        + ply(LITTLE, SQUARES, MIXED).partition(b"end_header")[2],
        3,
        (1, 1, 2),
    ),
    **{
        f"{name}.ply": (
            ply("ascii 1.0", SQUARES, MIXED).replace(b"element vertex", f"element {name}".encode()),
            3,
            (1, 1, 2),
        )
        for name in ("point", "Points", "vertices")
    },
    **{
        f"{name}.ply": (
            ply("ascii 1.0", SQUARES, MIXED).replace(b"element face", f"element {name}".encode()),
            3,
            (1, 1, 2),
        )
        for name in ("faces", "Polygon")
    },
    "own_list.ply": (ply(LITTLE, SQUARES, MIXED, name="ids"), 3, (1, 1, 2)),
    "nul_text.ply": (ply("ascii 1.0", SQUARES, MIXED) + b"\0\x1a", 3, (1, 1, 2)),
    "nul.ply": (ply(LITTLE, SQUARES, MIXED) + b"\0\r\n", 3, (1, 1, 2)),
}
FAST = {
    "triangles.obj": (f"{TRIANGLE}f 1 2 3\nf 3 2 1\n", 1, FLAT),
    "polygons.obj": (
        f"# a\no a\n{U_OBJ}g b\nf 1 2 3 4 5 6 7 8\ns 1\nf 1 2 3\nf 1 2\n",
        18,
        (4, 4, 0),
    ),
    "slashes.obj": (
        f"mtllib a\n{TRIANGLE}{UV}usemtl a\nf 1/1/1 2/2/2 3/3/3\nf 1//1 2//2 3//3\nf 1/1 2/2 3/3\n",
        1.5,
        FLAT,
    ),
    "returns.obj": (f"{TRIANGLE}f 1 2 3\n".replace("\n", "\r\n"), 0.5, FLAT),
    "no end.obj": (f"{TRIANGLE}f  1  2 3 ", 0.5, FLAT),
}
"""What the fast reader of OBJ reads; it leaves the rest to the slow one."""
REFUSED = {
    "apart.obj": (f"{TRIANGLE}f 1 / 1 2 / 2 3 / 3\n", "line 4"),
    "zero.obj": (f"{TRIANGLE}f 1 2 0\n", "outside the range"),
    "far.obj": (f"{TRIANGLE}f 1 2 3\nf 1 2 9\n{HIGH}", "vertex 8.*6 vertices"),
    "back.obj": (f"{TRIANGLE}f -4 -2 -1\n", "outside the range"),
    "word.obj": ("v 0 0 0\nv 1 x 0\nv 0 1 0\nf 1 2 3\n", "line 2"),
    "two.obj": (f"{TRIANGLE}f 1 2 3\nf 1 9\n", "outside the range"),
    "patch.obj": (f"{TRIANGLE}f 1 2 3\nsurf 0 1 0 1 1 2 3\n", "line 5: surf"),
    "more.off": (CUBE_OFF.replace("8 6", "8 5"), "declares 8 vertices and 5 faces"),
    "fewer.off": (CUBE_OFF.replace("8 6", "8 7"), "declares 8 vertices and 7 faces"),
    "less.off": (CUBE_OFF.replace("8 6", "-1 15"), "declares -1 vertices"),
    "minus.off": (f"{CUBE_OFF}\n-3 0 1 2".replace("8 6", "8 7"), "declares 8 vertices and 7"),
    "free.off": (f"OFF 8 6 0\n{' '.join(CORNERS)} {' '.join(SIDES)}", "a line holds several"),
    "four.off": ("4OFF\n3 1 0\n0 0 0 1\n1 0 0 1\n0 1 0 1\n3 0 1 2\n", "not in three dim"),
    "binary.off": (b"OFF BINARY\n\0\0\0\3\0\0\0\1", "is a binary OFF"),
    "cut.stl": (stl(9, 2), "announces 9 triangles, but holds 2"),
    "text.stl": (f"solid a\n{SIDE.format(0)}{SIDE.format(1)[:40]}", "line 9: no facet of three"),
    "open.stl": (f"solid a\n{SIDE.format(0)}", "no endsolid"),
    "square.stl": (
        f"solid\n{SIDE.format(0)}endsolid".replace("endloop", "vertex 1 1 0\nendloop"),
        "line 2: no facet of three vertices",
    ),
    "none.stl": (stl(0, 0), "no faces"),
    "nan.stl": (stl(1, 1).replace(struct.pack("<f", 1), struct.pack("<f", np.nan)), "NaN"),
    **{
        f"{name}_text.ply": (ply("ascii 1.0", SQUARES, [(0, 1, 2), (0, 1, 3)])[:-8] + row, message)
        for name, row, message in (
            ("no", b"", "declares 2 rows of face"),
            ("short", b"3 0 1\n", "cut short"),
            ("word", b"3 0 1 x\n", "PLY"),
        )
    },
    "cut.ply": (ply(LITTLE, SQUARES, MIXED)[:-1], "cut short"),
    "more.ply": (ply("ascii 1.0", SQUARES, MIXED) + b"3 0 1 2\n", "more values"),
    "other.ply": (
        ply(LITTLE, SQUARES, MIXED).replace(b"element vertex", b"element corner"),
        "only corner",
    ),
    "twice.ply": (ply("ascii 1.0", SQUARES, MIXED).replace(b"face", b"vertex"), "header"),
    "ragged.off": (CUBE_OFF.replace("0 0 0\n", "0 0 0 0\n"), "declares 8 vertices"),
    "nan.obj": (f"{TRIANGLE}v 0 nan 0\nf 4 2 3\n", "NaN"),
    "nine.off": ("nOFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "not in three dim"),
    "far.ply": (ply(BIG, SQUARES, [(0, 1, 2, 7)]), "outside the range"),
    **{
        f"length_{length}.ply": (
            ply("ascii 1.0", SQUARES, MIXED).replace(b"4 0 1 2 3", length + b" 0 1 2 3"),
            "a list of face has the length",
        )
        for length in (b"4.5", b"-4", b"nan", b"1e300")
    },
    "rest.ply": (ply(LITTLE, SQUARES, MIXED).replace(b"face 3", b"face 2"), "more values"),
    "fewer.stl": (stl(1, 2), "announces 1 triangles, but holds 2"),
    "two.stl": (stl(1, 1, tail=stl(2, 2)), "announces 1 triangles"),
    "none_announced.stl": (stl(0, 2), "announces 0 triangles, but holds 2"),
    "server.stl": ("404: Not Found", "the answer of a server"),
    "page.stl": ("\ufeff<body>Sorry</body>", "a web page"),
    "image.stl": ('<svg xmlns="http://www.w3.org/2000/svg"/>', "it is XML"),
    "answer.obj": ('[{"error": "gone"}]', "it is JSON"),
    "underscore.stl": (f"solid\n{SIDE.format('1_0')}endsolid", "line 2: no facet"),
    "nan_text.stl": (
        f"solid\n{SIDE.format(0)}{SIDE.format('nan')}endsolid",
        f"line {SIDE.count(chr(10)) + 2}: no facet of three vertices",
    ),
    "comma.stl": (f"solid\n{SIDE.format('0,5')}endsolid", "line 2: no facet of three vertices"),
    "underscore.obj": (TRIANGLE.replace("v 1", "v 1_0") + "f 1 2 3", "line 2"),
    "underscore.off": (CUBE_OFF.replace("1 1 1\n", "1_0 1 1\n"), "a word with _"),
    "vast.obj": (TRIANGLE.replace("1", "1e200") + "f 1 2 3", "1e.200 units long"),
    "minute.obj": (TRIANGLE.replace("1", "1e-200") + "f 1 2 3", "1e-200 units long"),
    "away.obj": ("v 0 1e20 0\nv 1 1e20 0\nv 0 1e20 1\nf 1 2 3", "1e.20 units from the origin"),
    "mark.ply": (ply("ascii 2.0", SQUARES, MIXED).replace(b"uchar", b"word"), "header: .*word"),
}


def written(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", READ | FAST)
def test_valid_files_have_their_area_and_size(tmp_path: Path, name: str) -> None:
    content, area, size = (READ | FAST)[name]
    if name in FAST:
        assert text_formats._plain_obj(content.encode()) is not None
    mesh = load_mesh(written(tmp_path / name, content))
    assert mesh.area == pytest.approx(area, rel=1e-6)
    np.testing.assert_allclose(mesh.extents, size, atol=1e-6)


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_hold_other_than_they_declare_are_refused(tmp_path: Path, name: str) -> None:
    content, message = REFUSED[name]
    path = written(tmp_path / name, content)
    with refused(message, path):
        load_mesh(path)


def test_a_mesh_that_single_precision_bends_is_named(tmp_path: Path, caplog) -> None:
    TOLD.clear()
    corners = np.array([[0, 5_400_000, 0], [0.3, 5_400_000, 0], [0, 5_400_000, 0.3]])
    facet = bytes(12) + corners.astype("<f4").tobytes() + bytes(2)
    load_mesh(written(tmp_path / "a.stl", bytes(80) + struct.pack("<I", 1) + facet))
    assert (
        "a.stl: lies 5.4e+06 units from the origin, where numbers are rounded to 0.5" in caplog.text
    )
