"""MAT files as SciPy writes them, and hostile ones written by hand."""

import struct
import zlib

import numpy as np
import pytest
from scipy.io import savemat

from qs3.errors import InputError
from qs3.io import guards
from qs3.io.extract.matlab import read_mat, struct_rows

from ..hostile import refused
from .sun_writers import structs


@pytest.mark.parametrize("compressed", [True, False])
def test_structs_cells_text_and_numbers(tmp_path, compressed):
    inner = structs(
        [{"word": "größe", "row": np.ones((1, 3))}, {"word": "", "row": np.ones((3, 1))}]
    )
    outer = structs([{"list": inner, "n": 1.0}, {"list": np.zeros((0, 0)), "n": np.eye(3)}])
    variables = {"table": outer, "names": np.array(["one", "two words"], dtype=object)}
    savemat(tmp_path / "a.mat", variables | {"other": np.eye(3)}, do_compression=compressed)
    values = read_mat(tmp_path / "a.mat", ("table", "names", "absent"))
    assert set(values) == {"table", "names"}
    assert values["names"].tolist() == ["one", "two words"]
    first, second = struct_rows(values["table"], "table")
    assert (first["n"], second["n"]) == (1.0, np.eye(3).tolist())
    rows = struct_rows(first["list"], "list")
    assert rows == [{"word": "größe", "row": [1.0] * 3}, {"word": "", "row": [1.0] * 3}]
    assert struct_rows(second["list"], "list") == []
    for wrong in (first["n"], values["names"], "text"):
        with pytest.raises(InputError, match="here: is not a struct array"):
            struct_rows(wrong, "here")


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


def nested(depth):
    return matrix(1, (1, 1), nested(depth - 1) if depth else b"")


FIELDS = element(5, struct.pack("<i", 8)) + element(1, b"K\0\0\0\0\0\0\0")
MANY_FIELDS = element(5, struct.pack("<i", 1)) + element(1, b"K" * 4096)
BAD = {
    "empty": (b"", "not a MAT file"),
    "words": (b"hello" * 100, "not a MAT file"),
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
                "announces 1152921504606846976"),
    "text": (mat(matrix(4, (1, 2**31 - 1), element(2, b""))), "announces 2147483647"),
    "fields": (mat(matrix(2, (1, 2**20), MANY_FIELDS)),
               "announces 4294967296 elements"),
    "within": (mat(matrix(1, (1, 1), matrix(1, (2**31 - 1, 9), b"", b""))), "announces"),
    "object": (mat(matrix(3, (1, 1), b"")), "an object or a function"),
    "deep": (mat(nested(40)), "damaged"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_hostile_files_are_refused_in_one_line(tmp_path, name):
    content, message = BAD[name]
    path = tmp_path / "bad.mat"
    path.write_bytes(content)
    with refused(message, path):
        read_mat(path, ("SUNRGBDMeta",))


def test_more_arrays_than_memory_holds_are_refused(tmp_path, monkeypatch):
    savemat(tmp_path / "a.mat", {"names": np.array(["x"] * 1000, dtype=object)})
    assert len(read_mat(tmp_path / "a.mat", ("names",))["names"]) == 1000
    monkeypatch.setenv(guards.LIMIT, str(100_000 / 2**30))
    with pytest.raises(InputError, match="tree of 1001 arrays announces 128128 bytes"):
        read_mat(tmp_path / "a.mat", ("names",))


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_mat(tmp_path / "absent.mat", ())
