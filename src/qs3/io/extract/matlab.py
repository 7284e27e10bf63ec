"""MATLAB's MAT files of version 5 to 7, as far as tables of a data set need: no objects, no code.

Every size that a file announces is held against its bytes before anything is allocated, and a field
is parsed when it is asked for. Layout: "MAT-File Format", MathWorks, Level 5 MAT-files.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError

_LARGEST_FILE = 1 << 30
_LARGEST_VARIABLE = 1 << 31
_DEFLATE_AT_BEST = 1032
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMBERS = range(6, 16)
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8",
          13: "u8"}  # fmt: skip
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_KINDS = {_CELL: "cells", _STRUCT: "struct", _CHAR: "text", **dict.fromkeys(_NUMBERS, "numbers")}


@dataclass(frozen=True)
class MatArray:
    """One array of a MAT file, not yet parsed."""

    where: str
    """File and variable, for messages."""
    kind: int
    """MATLAB's class: 1 cells, 2 struct, 4 text, 6 to 15 numbers."""
    shape: tuple[int, ...]
    """Its size along each dimension."""
    body: memoryview
    """What follows name and size."""
    order: str
    """``<`` or ``>``."""

    @property
    def count(self) -> int:
        """Number of its elements."""
        return math.prod(self.shape)

    def numbers(self, *shape: int) -> Float[np.ndarray, "..."]:
        """Return its numbers, held against a shape; one row is as good as one column.

        Raises:
            InputError: where it is no array of numbers of that shape.
        """
        if self.kind not in _NUMBERS:
            self._fail("is not an array of numbers")
        if self.shape != shape and not (len(shape) == 1 and self._vector(shape[0])):
            self._fail(f"has shape {list(self.shape)}, not {list(shape)}")
        kind, data, _ = _element(self.body, 0, self)
        if kind not in _TYPES or len(data) != self.count * np.dtype(_TYPES[kind]).itemsize:
            self._fail("is damaged")
        values = np.frombuffer(data, self.order + _TYPES[kind]).astype(np.float64)
        return values.reshape(shape, order="F")

    def _vector(self, size: int) -> bool:
        return len(self.shape) == 2 and self.count == size and 1 in self.shape

    def text(self) -> str:
        """Return its text; that of its only cell where it is one cell.

        Raises:
            InputError: where it is no line of text.
        """
        if self.kind == _CELL and self.count == 1:
            return next(self.cells()).text() if len(self.body) < 1 << 16 else self._fail("is long")
        if self.kind != _CHAR or len([side for side in self.shape if side != 1]) > 1:
            if self.count == 0:
                return ""
            self._fail("is not a line of text")
        kind, data, _ = _element(self.body, 0, self)
        coding = _TEXTS.get(kind, "latin-1")
        if coding[-2:] in ("16", "32"):
            coding += "-le" if self.order == "<" else "-be"
        try:
            return bytes(data).decode(coding)
        except UnicodeDecodeError:
            self._fail("is not text")

    def cells(self) -> Iterator["MatArray"]:
        """Yield the arrays in its cells.

        Raises:
            InputError: where it has none, or is cut off.
        """
        if self.kind != _CELL and self.count:
            self._fail("is not an array of cells")
        self._check_count(self.count, self.body)
        at = 0
        for index in range(self.count):
            array, at = _matrix(self.body, at, self, f"{self.where}{{{index + 1}}}")
            yield array

    def rows(self) -> Iterator[dict[str, "MatArray"]]:
        """Yield the fields of each element of a struct array; an empty array has none.

        Raises:
            InputError: where it is no struct array, or is cut off.
        """
        if self.kind != _STRUCT:
            if self.count:
                self._fail("is not a struct array")
            return
        kind, size, at = _element(self.body, 0, self)
        _, names, at = _element(self.body, at, self)
        length = struct.unpack(self.order + "i", size)[0] if kind == 5 and len(size) == 4 else 0
        if not 0 < length <= 64 or len(names) % length:
            self._fail("has damaged field names")
        fields = [
            bytes(names[i : i + length]).split(b"\0")[0].decode("latin-1")
            for i in range(0, len(names), length)
        ]
        self._check_count(self.count * len(fields), self.body[at:])
        for index in range(self.count if fields else 0):
            row: dict[str, MatArray] = {}
            for name in fields:
                where = f"{self.where}({index + 1}).{name}"
                row[name], at = _matrix(self.body, at, self, where)
            yield row

    def _check_count(self, count: int, body: memoryview) -> None:
        if 8 * count > len(body):
            self._fail(f"announces {count} elements but has {len(body)} bytes")

    def _fail(self, what: str) -> NoReturn:
        told = _KINDS.get(self.kind, "an object")
        raise InputError(f"{self.where} {what} (it is {told} of shape {list(self.shape)})")


def read_mat(path: Path, names: tuple[str, ...]) -> dict[str, MatArray]:
    """Open variables of a MAT file of version 5 to 7.

    Args:
        path: The file.
        names: Variables to open; others are passed over.

    Returns:
        Those of them that are there.

    Raises:
        InputError: where the file is missing, of another version, cut off or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size > _LARGEST_FILE:
        raise InputError(f"{path}: more than {_LARGEST_FILE} bytes; save only what is needed")
    content = path.read_bytes()
    if content[:10] == b"MATLAB 7.3" or content[512:520] == b"\x89HDF\r\n\x1a\n":
        raise InputError(f"{path}: of version 7.3; in MATLAB, save it anew with '-v7'")
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise InputError(f"{path}: not a MAT file of version 5 to 7")
    top = MatArray(str(path), _CELL, (1,), memoryview(content), order)
    found: dict[str, MatArray] = {}
    at = 128
    while at < len(content):
        kind, data, at = _element(top.body, at, top)
        if kind == _COMPRESSED:
            kind, data = _inflated(data, top)
        if kind != _MATRIX:
            continue
        array, name = _parse(data, top, "")
        if name in names and name not in found:
            where = f"{path}: {name}"
            found[name] = MatArray(where, array.kind, array.shape, array.body, order)
    return found


def _element(body: memoryview, at: int, owner: MatArray) -> tuple[int, memoryview, int]:
    """Type and bytes of the element at ``at``, and where the next begins."""
    if at + 8 > len(body):
        raise InputError(f"{owner.where}: cut off")
    kind, size = struct.unpack_from(owner.order + "II", body, at)
    if kind >> 16:  # up to four bytes within the tag
        kind, size = kind & 0xFFFF, kind >> 16
        start, end = at + 4, at + 8
        if size > 4:
            raise InputError(f"{owner.where}: damaged")
    else:
        start = at + 8
        end = start + size if kind == _COMPRESSED else start + -(-size // 8) * 8
        if start + size > len(body):
            raise InputError(f"{owner.where}: cut off, or damaged")
    return kind, body[start : start + size], end


def _inflated(data: memoryview, owner: MatArray) -> tuple[int, memoryview]:
    """The element in a compressed one, whose announced size bounds what is unpacked."""
    packer = zlib.decompressobj()
    try:
        tag = packer.decompress(data, 8)
        if len(tag) < 8:
            raise InputError(f"{owner.where}: cut off")
        kind, size = struct.unpack(owner.order + "II", tag)
        if size > min(_DEFLATE_AT_BEST * len(data) + 64, _LARGEST_VARIABLE):
            raise InputError(
                f"{owner.where}: announces {size} bytes in {len(data)} compressed ones"
            )
        content = packer.decompress(packer.unconsumed_tail, size) if size else b""
    except zlib.error as error:
        raise InputError(f"{owner.where}: damaged ({error})") from error
    if len(content) < size:
        raise InputError(f"{owner.where}: cut off")
    return kind, memoryview(content)


def _matrix(body: memoryview, at: int, owner: MatArray, where: str) -> tuple[MatArray, int]:
    kind, data, end = _element(body, at, owner)
    if kind != _MATRIX:
        raise InputError(f"{where}: damaged")
    return _parse(data, owner, where)[0], end


def _parse(data: memoryview, owner: MatArray, where: str) -> tuple[MatArray, str]:
    """An array and its name; one of no bytes is empty."""
    if not len(data):
        return MatArray(where, 6, (0, 0), data, owner.order), ""
    kind, flags, at = _element(data, 0, owner)
    if kind != 6 or len(flags) != 8:
        raise InputError(f"{where or owner.where}: damaged")
    code = struct.unpack_from(owner.order + "I", flags)[0] & 0xFF
    if code not in _KINDS:  # a sparse array, an object, a function: nothing to look into
        return MatArray(where, code, (), data[:0], owner.order), ""
    kind, sizes, at = _element(data, at, owner)
    if kind != 5 or not 8 <= len(sizes) <= 128 or len(sizes) % 4:
        raise InputError(f"{where or owner.where}: damaged")
    shape = struct.unpack(f"{owner.order}{len(sizes) // 4}i", sizes)
    if min(shape) < 0:
        raise InputError(f"{where or owner.where}: damaged")
    _, name, at = _element(data, at, owner)
    label = bytes(name).decode("latin-1")
    return MatArray(where, code, shape, data[at:], owner.order), label
