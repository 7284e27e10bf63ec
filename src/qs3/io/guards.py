"""What files of strangers announce, held against what they hold, before a library takes them over.

Every reader of files that others made comes through here: sizes first, then the library, and
whatever that raises becomes one line. Nothing is ever unpickled. Guards that follow the structure
of one format stand beside its reader: `layouts.hdf5`, `ply`.
"""

import contextlib
import dataclasses
import io
import math
import os
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.files import read_json
from qs3.structure import structure

Numbers = tuple[float, ...] | tuple[tuple[float, ...], ...]
"""A vector, or a matrix row by row, of a JSON file."""

LIMIT = "QS3_LARGEST_FILE_GIB"
"""Environment variable: GiB that a file read into memory at once may have or announce; 2."""
DENSEST = 100
"""Largest ratio of announced to stored bytes; coordinates do not compress that well."""
LARGEST_IMAGE = 1 << 25
"""Pixels; twice what any depth camera has."""

_Kind = TypeVar("_Kind")
_SLACK = 1 << 26  # labels of many clouds compress by more
_LONGEST_TEXT = 1 << 20
_LONGEST_LINE = 1 << 20
_MOST_MEMBERS = 50_000
_DEFLATE_AT_BEST = 1032
_DEEP = {"I;16": 16, "I;16B": 16, "I;16L": 16, "I": 32, "F": 32}  # bits a pixel, by Pillow's mode
# What a zip file's lies and damages raise, by its many parts.
_ZIP_FAULTS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError,
               struct.error)  # fmt: skip


def reason(error: Exception) -> str:
    """The first line of what a library raised; its type where it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0]


@contextlib.contextmanager
def naming(where: Any, fault: str = "", kind: type[Exception] = Exception) -> Iterator[None]:
    """Put a name before the `InputError` of a block, unless it stands there.

    Args:
        where: What is read.
        fault: What an exception of ``kind`` is told as, with its reason: for libraries that raise
            whatever they stumble over. Without it such an exception passes.
        kind: What the library raises, where that is told apart from faults of our own.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error
    except kind as error:
        if not fault:
            raise
        raise InputError(f"{where}: {fault} ({reason(error)})") from error


def utf8(name: str) -> str:
    r"""The name of a file as it is; bytes of it that are no UTF-8 as escapes.

    Example:
        >>> print(utf8("st\udcffhl"), utf8("Stühle"))
        st\udcffhl Stühle
    """
    return name.encode("utf-8", errors="backslashreplace").decode("utf-8")


def most_bytes() -> int:
    """Largest size of what a file announces, or is itself, where it is read into memory at once.

    Raises:
        InputError: where ``QS3_LARGEST_FILE_GIB`` is no number above 0.
    """
    word = os.environ.get(LIMIT) or "2"
    try:
        most = int(float(word) * 2**30)
    except (ValueError, OverflowError):
        most = 0
    if most < 1:
        raise InputError(f"{LIMIT}={word}: a number of GiB above 0 is needed")
    return most


def check_announced(what: str, announced: int, stored: int, densest: int = DENSEST) -> None:
    """Refuse an announced size above `most_bytes`, or above what the file can hold of it.

    Args:
        what: What is announced, for the message.
        announced: Bytes that it would take.
        stored: Bytes of the file that hold it.
        densest: Largest ratio of the two; 1 where nothing is compressed.
    """
    if announced > (most := most_bytes()):
        raise InputError(
            f"{what} announces {announced} bytes; read are {most} at most: split the file, or, "
            f"where you trust it, set {LIMIT} to a larger number than {most / 2**30:g}"
        )
    if announced > (stored if densest == 1 else max(_SLACK, densest * stored)):
        raise InputError(
            f"{what} announces {announced} bytes, but the file has {stored} of it; cut off, or "
            "made to fill the memory"
        )


def read_small(path: Path, largest: int | None = None, what: str = "the file") -> bytes:
    """Read a file of at most ``largest`` bytes, `most_bytes` where it is None; none longer."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if largest is None:
        check_announced(f"{path}: {what}", path.stat().st_size, path.stat().st_size)
    elif path.stat().st_size > largest:
        raise InputError(f"{path}: {path.stat().st_size} bytes, too long for {what}")
    return path.read_bytes()


def read_text(path: Path, largest: int = _LONGEST_TEXT) -> str:
    """Read a short text in UTF-8; anything else is refused."""
    try:
        return read_small(path, largest, "a list or a table").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: no text in UTF-8") from None


def text_lines(content: bytes) -> Iterator[tuple[int, str]]:
    """Yield the lines of a long text in UTF-8 with their numbers from 1; nothing holds them all.

    Raises:
        InputError: where a line is too long for a row of numbers.
    """
    for number, line in enumerate(io.TextIOWrapper(io.BytesIO(content), "utf-8"), start=1):
        if len(line) > _LONGEST_LINE:
            raise InputError(
                f"line {number} has {len(line)} characters; read are {_LONGEST_LINE} at most, one "
                "line a point"
            )
        yield number, line


def read_numbers(path: Path, counts: tuple[int, ...]) -> Float[np.ndarray, "n"]:
    """Read a text file of numbers, as many as one of ``counts``, apart by white space."""
    words = read_text(path).split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        raise InputError(f"{path}: not a text file of numbers") from None
    if len(numbers) not in counts:
        wanted = " or ".join(map(str, counts))
        raise InputError(f"{path}: {len(numbers)} numbers instead of {wanted}")
    return numbers


def read_small_json(path: Path, largest: int = 1 << 30) -> Any:
    """Read a JSON file of at most ``largest`` bytes; a longer one is refused."""
    if path.is_file() and path.stat().st_size > largest:
        raise InputError(f"{path}: {path.stat().st_size} bytes, more than the {largest} expected")
    return read_json(path)


def pick(value: Any, kind: type[_Kind], where: str | Path) -> _Kind:
    """Take the fields of a dataclass out of a table of somebody's file, which may hold more."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: not a JSON object; a table of names and values is needed")
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return structure({key: value[key] for key in value if key in names}, kind, where)


def as_matrix(numbers: Numbers, name: str) -> Float[np.ndarray, "3 3"]:
    """Return nine numbers, nested or not, as a matrix row by row; of others ``name`` is told."""
    flat = [n for row in numbers for n in (row if isinstance(row, tuple) else (row,))]
    if len(flat) != 9:
        raise InputError(f"{name} must be 9 numbers, not {len(flat)}")
    return np.array(flat).reshape(3, 3)


def load_npy(
    content: bytes, accept: Callable[[tuple[int, ...], np.dtype], None] | None = None
) -> np.ndarray:
    """Return the array of an npy file; it shares the memory of ``content`` and is not writable.

    ``accept`` raises where shape and type are not what is asked for; it is called before the
    numbers are looked at. Damaged files, objects, and more announced than there is are refused.
    """
    handle = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(handle)
        readers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        shape, in_columns, kind = readers[version](handle)
    except Exception as error:  # whatever a damaged header makes NumPy stumble over
        raise InputError(f"cannot be read as npy ({reason(error)})") from error
    if kind.hasobject:
        raise InputError("cannot be read as npy (holds pickled objects, which are never loaded)")
    if accept is not None:
        accept(shape, kind)
    count, begin = math.prod(shape), handle.tell()
    size, held = count * kind.itemsize, len(content) - begin
    check_announced(f"npy array of {kind} {list(shape)}", size, held, densest=1)
    if min(shape, default=0) < 0 or not kind.itemsize:
        raise InputError(f"cannot be read as npy ({kind} of shape {list(shape)})")
    flat = np.frombuffer(content, kind, count, begin)
    return flat.reshape(shape[::-1]).T if in_columns else flat.reshape(shape)


@contextlib.contextmanager
def open_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip file, unless it lists more members than any of this field."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with path.open("rb") as handle:
            handle.seek(max(0, path.stat().st_size - 2**16 - 22))  # the end, with its comment
            _, _, end = handle.read().rpartition(b"PK\5\6")
        members = struct.unpack_from("<6xH", end)[0] if len(end) >= 8 else 0
        archive = zipfile.ZipFile(path) if members <= _MOST_MEMBERS else None
    except _ZIP_FAULTS as error:
        raise InputError(f"{path}: cannot be read as zip ({reason(error)})") from error
    if archive is None:
        raise InputError(f"{path}: has {members} members; read are {_MOST_MEMBERS} at most")
    with archive:
        yield archive


def read_member(archive: zipfile.ZipFile, name: str, most: int | None = None) -> bytes | None:
    """Return a member of a zip file by its exact name; None where there is none.

    Raises:
        InputError: where it is damaged, packed in a way that cannot be bounded, or announces
            more than ``most`` bytes, than `most_bytes`, or than it can hold.
    """
    try:
        entry = archive.getinfo(name)
    except KeyError:
        return None
    if most is not None and entry.file_size > most:
        raise InputError(f"{name} would unpack to {entry.file_size} bytes, more than {most}")
    check_announced(name, entry.file_size, entry.compress_size)
    # The other packings of zip unpack in blocks that cannot be bounded.
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(f"{name} is packed in an unusual way; pack it with deflate")
    try:
        with archive.open(entry) as member:
            return member.read(entry.file_size + 1)
    except _ZIP_FAULTS as error:
        raise InputError(f"{name} is damaged ({reason(error)})") from error


def check_pixels(width: int, height: int) -> None:
    """Refuse a size that no depth image has."""
    if width < 1 or height < 1 or width * height > LARGEST_IMAGE:
        raise InputError(
            f"announces {width}×{height} pixels; read are images of up to {LARGEST_IMAGE} pixels"
        )


def read_image(content: bytes, kind: Literal["PNG", "TIFF"]) -> tuple[np.ndarray, str]:
    """Return an image, numbers as stored, and Pillow's mode (``L``, ``I;16``, ``F``, ``RGB`` …).

    Of a PNG every chunk's length and checksum is looked at before anything is decoded.

    Raises:
        InputError: where it is of another kind, cut off or damaged, or announces more pixels than
            any depth image has or than its bytes could hold.
    """
    # Imported here: npy files need no image library.
    import cv2
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(content), formats=(kind,)) as image:
                size, mode = image.size, image.mode
                check_pixels(*size)
                image.verify()
        except InputError:
            raise
        except Image.DecompressionBombError:
            raise InputError(f"announces more than {LARGEST_IMAGE} pixels") from None
        except Image.UnidentifiedImageError:
            raise InputError(f"not a {kind} file, whatever its name says, or damaged") from None
        except Exception as error:  # its parsers raise whatever they stumble over
            raise InputError(f"cut off or damaged ({reason(error)})") from error
    if size[0] * size[1] * _DEEP.get(mode, 1) // 8 > _DEFLATE_AT_BEST * len(content):
        raise InputError(f"announces {size[0]}×{size[1]} pixels but has {len(content)} bytes")
    # OpenCV's complaints would stand beside our one line.
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        decoded = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if decoded is None or decoded.shape[1::-1] != size:
        raise InputError("damaged, or of a kind that OpenCV cannot read")
    return decoded, mode
