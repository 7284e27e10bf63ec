"""Our reader of MAT files against SciPy's writer and reader."""

import struct
import zlib

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from qs3.errors import InputError
from qs3.io.extract.matlab import read_mat

from .sun_writers import structs

KINDS = ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]


def saved(path, compressed=True, **variables):
    savemat(path, variables, do_compression=compressed)
    return path


@pytest.mark.parametrize("compressed", [True, False])
def test_numbers_of_every_type_and_shape(tmp_path, rng, compressed):
    arrays = {f"a_{kind}": rng.integers(0, 100, (3, 4)).astype(kind) for kind in KINDS}
    path = saved(tmp_path / "a.mat", compressed, **arrays, cube=rng.normal(size=(2, 3, 4)))
    reference = loadmat(path)
    found = read_mat(path, (*arrays, "cube", "absent"))
    assert set(found) == {*arrays, "cube"}
    for name, array in found.items():
        np.testing.assert_array_equal(array.numbers(*array.shape), reference[name])


@pytest.mark.parametrize("compressed", [True, False])
def test_structs_cells_and_text(tmp_path, compressed):
    inner = structs(
        [{"word": "größe", "row": np.ones((1, 3))}, {"word": "", "row": np.ones((3, 1))}]
    )
    outer = structs([{"list": inner, "n": 1.0}, {"list": np.zeros((0, 0)), "n": 2.0}])
    names = np.array(["one", "two words"], dtype=object).reshape(1, 2)
    path = saved(tmp_path / "a.mat", compressed, table=outer, names=names, other=np.eye(3))
    found = read_mat(path, ("table", "names"))
    assert [cell.text() for cell in found["names"].cells()] == ["one", "two words"]
    first, second = found["table"].rows()
    assert first["n"].numbers(1).tolist() == [1.0]
    assert not list(second["list"].rows())
    words = list(first["list"].rows())
    assert [row["word"].text() for row in words] == ["größe", ""]
    assert [row["row"].numbers(3).tolist() for row in words] == [[1.0] * 3] * 2


def test_what_is_asked_wrongly_is_told_with_its_place(tmp_path):
    outer = structs([{"list": np.eye(3), "word": "w"}])
    path = saved(tmp_path / "a.mat", table=outer, names=np.array(["a"], dtype=object))
    table, names = read_mat(path, ("table", "names")).values()
    (row,) = table.rows()
    for call in (
        row["list"].text,
        lambda: row["list"].numbers(9),
        lambda: row["word"].numbers(1),
        lambda: list(row["list"].cells()),
        lambda: list(row["word"].rows()),
        lambda: list(names.rows()),
    ):
        with pytest.raises(InputError, match=r"a\.mat: (table|names)"):
            call()


def element(kind, body):
    return struct.pack("<II", kind, len(body)) + body + b"\0" * (-len(body) % 8)


def matrix(code, shape, rest, name=b"SUNRGBDMeta"):
    parts = element(6, struct.pack("<II", code, 0)) + element(
        5, struct.pack(f"<{len(shape)}i", *shape)
    )
    return element(14, parts + element(1, name) + rest)


def mat(body):
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + body


def packed(body, announced=None):
    if announced is not None:
        body = struct.pack("<II", 14, announced) + body[8:]
    small = zlib.compress(body)
    return struct.pack("<II", 15, len(small)) + small


FIELDS = element(5, struct.pack("<i", 8)) + element(1, b"K\0\0\0\0\0\0\0")
BAD = {
    "empty": (b"", "not a MAT file"),
    "text": (b"hello" * 100, "not a MAT file"),
    "hdf5": (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n", "save it anew with '-v7'"),
    "beyond": (mat(struct.pack("<II", 14, 2**31)), "cut off"),
    "half a tag": (mat(b"\0\0\0\0"), "cut off"),
    "bomb": (mat(packed(matrix(6, (1, 1), b""), 2**31 - 8)), "announces 2147483640 bytes"),
    "not zlib": (mat(struct.pack("<II", 15, 16) + b"x" * 16), "damaged"),
    "cells": (mat(matrix(1, (2**31 - 1, 2**31 - 1), b"")), "announces 4611686014132420609"),
    "structs": (mat(matrix(2, (2**31 - 1, 1000), FIELDS)), "announces 2147483647000 elements"),
    "negative": (mat(matrix(2, (-1, 1), FIELDS)), "damaged"),
    "no dimensions": (mat(matrix(2, (), FIELDS)), "damaged"),
    "no fields": (mat(matrix(2, (1, 1), element(5, struct.pack("<i", 0)) + element(1, b""))),
                  "field names"),
    "numbers": (mat(matrix(6, (2**30, 2**30), element(9, b"\0" * 8))),
                "is not an array of cells"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_hostile_files_are_refused_in_one_line(tmp_path, name):
    content, told = BAD[name]
    path = tmp_path / "bad.mat"
    path.write_bytes(content)
    with pytest.raises(InputError, match=told) as caught:
        table = read_mat(path, ("SUNRGBDMeta",))["SUNRGBDMeta"]
        list(table.rows() if table.kind == 2 else table.cells())
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_mat(tmp_path / "absent.mat", ())
