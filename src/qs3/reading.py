"""The guard around every reader of a file: a regular file, checked sizes, errors of one line."""

import codecs
import contextlib
import re
import threading
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from qs3.errors import InputError, QS3Error

MOST_BYTES = 8 << 30
"""Largest file that is read as a whole, and most memory that reading one may take."""

_BASE, _SHARE = 2 << 30, 32  # reading a file may take so many bytes, and times its size
_HTML = rb"(?i:(\xef\xbb\xbf)?\s*(<(!--|\?xml).*)?<(!doctype\s+html|html|head|body|script|meta)\b)"
_FOREIGN = (
    (_HTML, "a web page (HTML); download the file itself", ()),
    (rb"version https://git-lfs", "a pointer of Git LFS; git lfs pull fetches the file", ()),
    (rb"\S*/annex/objects/", "a pointer of git-annex; git annex get fetches the file", ()),
    (rb"PK\x03\x04", "a zip archive; unpack it", (".3mf", ".npz")),
    (rb"\x1f\x8b", "compressed by gzip; unpack it", ()),
    (rb"BZh[1-9]1AY", "compressed by bzip2; unpack it", ()),
    (rb"\xfd7zXZ\0", "compressed by xz; unpack it", ()),
    (rb"\x28\xb5\x2f\xfd", "compressed by Zstandard; unpack it", ()),
    (rb"7z\xbc\xaf\x27\x1c", "a 7z archive; unpack it", ()),
    (rb"Rar!\x1a\x07", "a RAR archive; unpack it", ()),
    (rb".{257}ustar", "a tar archive; unpack it", ()),
    (rb"%PDF-", "a PDF", ()),
    (rb"\x89PNG\r\n", "a PNG image", (".png",)),
    (rb"\xff\xd8\xff", "a JPEG image", (".jpg", ".jpeg")),
    (rb"II\*\0|MM\0\*", "a TIFF image", (".tif", ".tiff")),
    (rb"\x89HDF\r\n", "HDF5; name it .h5", (".h5", ".hdf5", ".mat")),
    (rb"\x93NUMPY", "a NumPy array; name it .npy", (".npy",)),
    (rb"\x80[\x02-\x05]", "a pickle, which is never read; save it as .npy or .npz", ()),
    (rb"glTF[\x01-\x03]\0\0\0", "binary glTF; name it .glb", (".glb",)),
    (rb"(?i:ply)\s+(?i:format|comment|obj_info)\s", "a PLY file; name it .ply", (".ply",)),
    (rb"(\xef\xbb\xbf)?\s*ISO-10303-21", "a STEP file; name it .step", (".step", ".stp")),
    (rb"(?i:\s*solid\b.*\bfacet\s)", "an STL file; name it .stl", (".stl",)),
    (rb"(?i:\s*(st)?c?n?off\s)", "an OFF file; name it .off", (".off",)),
    (rb"(#[^\n]*\n)*\s*VERSION[ .]+[0-9.]+\s+FIELDS\s", "a PCD file; name it .pcd", (".pcd",)),
    (rb"\xd0\xcf\x11\xe0", "a native CAD or Office file; export it as STEP", ()),
    (rb"Kaydara FBX", "an FBX file; export it as GLB", ()),
    (rb"BLENDER", "a Blender file; export it as GLB", ()),
    (rb"LASF", "a LAS file; export it as PLY", ()),
    (rb"ASTM-E57", "an E57 file; export it as PLY", ()),
    (rb"(\xef\xbb\xbf)?\s*<[?!]?[A-Za-z]", "XML", ()),
    (rb"(\xef\xbb\xbf)?\s*(\{\s*[\"}]|\[\s*[\[{\"])", "JSON", (".json", ".gltf")),
    (
        rb"\s*\d{3}:? [A-Z][a-z]+( [A-Za-z]+)*\s*\Z",
        "the answer of a server, no file; download it",
        (),
    ),
)
"""Contents that are found under other endings, how to mend it, and the endings they belong to."""
_block = threading.local()


@contextlib.contextmanager
def naming(where: object) -> Iterator[None]:
    """Put a name before the message of an `InputError`, unless it stands there."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error


def fault_of(path: Path, error: InputError) -> str:
    """Return the message of an error, which names the path."""
    text = str(error)  # the 0 of 0.5 m is not cloud 0
    named = re.search(rf"(?<![\w.]){re.escape(str(path))}(?!\w|\.\d)", text)
    return text if named else f"{path}: {text}"


@contextlib.contextmanager
def reading(path: Path, kind: str = "", *, streamed: bool = False) -> Iterator[None]:
    """Guard a block that reads one file.

    The block may take 2 GiB of memory and 32 times the size of the file, at most ``MOST_BYTES``. It
    holds to that by `check_size`, before it unpacks or allocates what the file announces: a limit
    of the process would be one of its other threads too. Do not ``yield`` to other code within the
    block.

    Args:
        path: The file.
        kind: Name of its format, for messages; by default its ending.
        streamed: Whether it is read piece by piece, so that it may be larger than ``MOST_BYTES``.
    """
    with naming(path):
        outer = _most()
        try:
            size = _size_of(path := Path(path))
            if not streamed:
                check_size("the file", size, MOST_BYTES)
            _block.most = min(_BASE + _SHARE * size, MOST_BYTES)
            yield
        except InputError:
            if foreign := _foreign(path):
                raise InputError(foreign) from None
            raise
        except QS3Error:
            raise
        except PermissionError as error:
            raise InputError("cannot be read: no permission") from error
        except MemoryError as error:
            raise InputError("takes more memory than there is; simplify or split it") from error
        except Exception as error:  # parsers of damaged files raise anything
            name = kind or path.suffix[1:].upper() or "a file"
            text = str(getattr(error, "problem", "") or error)  # of YAML
            reason = (text.splitlines() or [type(error).__name__])[0]
            reason += " is missing or unknown" if type(error) is KeyError else ""
            fault = (
                _foreign(path) or f"cannot be read as {name} ({reason}); mend or export it again"
            )
            raise InputError(fault) from error
        finally:
            _block.most = outer


def _foreign(path: Path) -> str:
    """Return of which kind a file is, if that is not the kind of its ending; else nothing."""
    if path.is_file():
        with path.open("rb") as handle:
            head = handle.read(1024)
        for pattern, name, endings in _FOREIGN:
            if re.match(pattern, head, re.DOTALL) and path.suffix.lower() not in endings:
                kind = path.suffix[1:].upper() or "this file"
                return f"cannot be read as {kind}: it is {name}"
    return ""


def plain_text(data: bytes) -> bytes:
    """Return text without its byte order mark, and UTF-16 as UTF-8.

    Example:
        >>> plain_text("OFF".encode("utf-16"))
        b'OFF'
    """
    for mark, codec in ((codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be")):
        if data.startswith(mark) and b"\0" in data[2:4]:
            return data[2:].decode(codec).encode()
    return data.removeprefix(codecs.BOM_UTF8)


def plain_numbers(text: bytes) -> bytes:
    """Return text with plain NaN and minus, for -nan(ind) and 1.#QNAN of Windows, and U+2212.

    Example:
        >>> plain_numbers("\u22121 1.#QNAN".encode())
        b'-1 nan'
    """
    if b"nan(" in text or b"1.#" in text:
        text = re.sub(rb"(?i)[-+]?(nan\(\w*\)|1\.#(qnan|snan|ind|inf)\d*)", b"nan", text)
    return text.replace("\u2212".encode(), b"-")


def check_size(what: str, size: int, most: int | None = None) -> None:
    """Refuse to read, unpack or allocate more bytes than the block of `reading` may take."""
    limit = _most() if most is None else most
    if size > limit:
        raise InputError(f"{what} has {size} bytes, more than the limit of {limit}; split it")


def check_archive(members: zipfile.ZipFile) -> None:
    """Refuse an archive that unpacks to too much; a member never unpacks to more than it says."""
    check_size("its content", sum(entry.file_size for entry in members.infolist()))


def unpack(what: str, new: Callable[[], Any], data: bytes) -> bytes:
    """Unpack streams of bz2, lz4 or Zstandard; refuse more than the block may take.

    ``new`` makes a decompressor with ``decompress(data, most)``, as ``bz2.BZ2Decompressor`` is.
    """
    parts, size = [], 0
    while data:
        stream = new()
        parts.append(stream.decompress(data, _most() - size + 1))
        size += len(parts[-1])
        check_size(what, size)
        if not stream.eof:
            raise ValueError(f"{what} is cut off")
        data = stream.unused_data or b""
    return b"".join(parts)


def limit_memory(path: Path) -> None:
    """Limit this process, a child that reads one file with the library of others, as `reading`."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except (ImportError, OSError):  # not Linux
        return
    most = min(_BASE + _SHARE * path.stat().st_size, MOST_BYTES)
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    wanted = pages * resource.getpagesize() + most
    soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _most() -> int:
    return getattr(_block, "most", MOST_BYTES)


def _size_of(path: Path) -> int:
    if not path.exists():
        raise InputError("no such file")
    if not path.is_file():
        raise InputError("is a folder; name a file" if path.is_dir() else "is not a regular file")
    if not (size := path.stat().st_size):
        raise InputError("the file is empty")
    path.open("rb").close()  # some parsers call a file without permission missing
    return size
