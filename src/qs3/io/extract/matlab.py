"""MATLAB's MAT files of version 5 to 7: SciPy reads them, once their announced sizes are held.

A cell or struct array of a few bytes may announce billions of elements, a compressed variable may
unpack to the whole memory, nested cells may overrun the stack, and a wrong type of element ends the
whole process within SciPy. So the tree of arrays is walked before SciPy sees it. Layout: "MAT-File
Format", MathWorks, Level 5 MAT-files.
"""

import io
import math
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.io.guards import check_announced, naming, read_small

_LARGEST_FILE = 1 << 30
_DEFLATE_AT_BEST = 1032
_BYTES_AN_ARRAY = 128  # of each array in a cell or a struct, once SciPy has made it
_DEEPEST = 16
_INT32, _UINT32, _MATRIX, _COMPRESSED = 5, 6, 14, 15
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMBERS = range(6, 16)
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}  # bytes, by type of number
_COMPLEX = 0x0800
_TEXTS = (1, 2, 4, 16, 17, 18)


def read_mat(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Read those of some variables that a MAT file of version 5 to 7 has; others are passed over.

    A struct array comes as a list of dicts, numbers as arrays without dimensions of length 1, text
    as text.

    Raises:
        InputError: where the file is missing, of another version, cut off or damaged, announces
            more than it holds, or has a sparse array, an object or a function in it.
    """
    # Imported here: other data sets have no MAT files.
    from scipy.io import loadmat

    content = read_small(path, _LARGEST_FILE, "a table of boxes; save only what is needed")
    if content[:10] == b"MATLAB 7.3" or content[512:520] == b"\x89HDF\r\n\x1a\n":
        raise InputError(f"{path}: of version 7.3; in MATLAB, save it anew with '-v7'")
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise InputError(f"{path}: not a MAT file of version 5 to 7")
    with naming(path, "damaged"):
        _check_file(memoryview(content), order, names)
        values = loadmat(io.BytesIO(content), variable_names=names, simplify_cells=True)
    return {name: values[name] for name in names if name in values}


def struct_rows(value: Any, where: str) -> list[dict[str, Any]]:
    """Return the elements of a struct array, arrays in them as lists; an empty array has none."""
    rows = [value] if isinstance(value, dict) else value
    if isinstance(rows, np.ndarray) and rows.size == 0:
        return []
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{where}: is not a struct array")
    return [{name: _plain(inner) for name, inner in row.items()} for row in rows]


def _plain(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value.item() if isinstance(value, np.generic) else value
    if value.size == 0 and value.dtype.kind == "U":
        return ""  # SciPy gives an empty text as an empty array
    return value.tolist() if value.dtype.kind != "f" else value.astype(np.float64).tolist()


def _check_file(content: memoryview, order: str, names: tuple[str, ...]) -> None:
    at, arrays = 128, 0
    while at < len(content):
        kind, data, at = _element(content, at, order)
        if kind == _COMPRESSED:
            kind, data = _inflated(data, order)
        if kind == _MATRIX:
            arrays += _check_array(data, order, names)
    whole = arrays * _BYTES_AN_ARRAY
    check_announced(f"its tree of {arrays} arrays", whole, whole)


def _check_array(data: memoryview, order: str, names: tuple[str, ...] = (), depth: int = 0) -> int:
    """Hold the announced elements of an array and of all arrays in it, which are counted."""
    if not len(data):
        return 1
    kind, flags, at = _element(data, 0, order)
    if kind != _UINT32 or len(flags) != 8 or depth > _DEEPEST:
        raise InputError("damaged")
    word = struct.unpack_from(order + "I", flags)[0]
    code = word & 0xFF
    kind, sizes, at = _element(data, at, order)
    if kind != _INT32 or not 8 <= len(sizes) <= 128 or len(sizes) % 4:
        raise InputError("damaged")
    shape = struct.unpack(f"{order}{len(sizes) // 4}i", sizes)
    _, name, at = _element(data, at, order)
    if depth == 0 and bytes(name).decode("latin-1") not in names:
        return 0  # SciPy passes it over
    if code not in (_CELL, _STRUCT, _CHAR, *_NUMBERS):
        raise InputError("holds a sparse array, an object or a function; save plain tables")
    count = math.prod(shape)
    if min(shape) < 0:
        raise InputError("damaged")
    if code == _STRUCT:
        kind, length, at = _element(data, at, order)
        width = struct.unpack(order + "i", length)[0] if len(length) == 4 else 0
        _, fields, at = _element(data, at, order)
        if kind != _INT32 or not 0 < width <= 64 or len(fields) % width:
            raise InputError("has damaged field names")
        count *= len(fields) // width
    least = 8 if code in (_CELL, _STRUCT) else 1
    if count * least > len(data) - at:
        raise InputError(f"announces {count} elements but has {len(data) - at} bytes")
    # SciPy takes types and numbers of elements on trust: what is wrong there ends the process.
    expected = count if code in (_CELL, _STRUCT) else 2 if word & _COMPLEX else 1
    elements, arrays = 0, 1
    while at < len(data):
        kind, inner, at = _element(data, at, order)
        elements += 1
        if code in (_CELL, _STRUCT) and kind == _MATRIX:
            arrays += _check_array(inner, order, depth=depth + 1)
        elif not (code == _CHAR and kind in _TEXTS) and not (
            code in _NUMBERS and len(inner) == count * _SIZES.get(kind, -1)
        ):
            raise InputError("damaged")
    if elements != expected:
        raise InputError("damaged")
    return arrays


def _element(data: memoryview, at: int, order: str) -> tuple[int, memoryview, int]:
    """Type and bytes of the element at ``at``, and where the next begins."""
    if at + 8 > len(data):
        raise InputError("cut off")
    kind, size = struct.unpack_from(order + "II", data, at)
    if kind >> 16:  # up to four bytes within the tag
        kind, size = kind & 0xFFFF, kind >> 16
        start, end = at + 4, at + 8
    else:
        start = at + 8
        end = start + size if kind == _COMPRESSED else start + -(-size // 8) * 8
    if start + size > min(len(data), end):
        raise InputError("cut off, or damaged")
    return kind, data[start : start + size], end


def _inflated(data: memoryview, order: str) -> tuple[int, memoryview]:
    """The element in a compressed one, whose announced size bounds what is unpacked."""
    packer = zlib.decompressobj()
    tag = packer.decompress(data, 8)
    if len(tag) < 8:
        raise InputError("cut off")
    kind, size = struct.unpack(order + "II", tag)
    check_announced("a variable", size, len(data) + 1, _DEFLATE_AT_BEST)
    content = packer.decompress(packer.unconsumed_tail, size) if size else b""
    if len(content) < size:
        raise InputError("cut off")
    return kind, memoryview(content)
