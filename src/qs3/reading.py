"""The guard around every reader of a file: a regular file, checked sizes, errors of one line."""

import contextlib
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

from qs3.errors import InputError, QS3Error

MOST_BYTES = 8 << 30
"""Largest file that is read as a whole, and most memory that reading one may take."""

_BASE, _SHARE = 2 << 30, 32  # reading a file may take so many bytes, and times its size
_block = threading.local()


@contextlib.contextmanager
def naming(where: object) -> Iterator[None]:
    """Put a name before the message of an `InputError`, unless it stands there."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error


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
        except QS3Error:
            raise
        except PermissionError as error:
            raise InputError("cannot be read: no permission") from error
        except MemoryError as error:
            raise InputError("takes more memory than there is; simplify or split it") from error
        except Exception as error:  # parsers of damaged files raise anything
            name = kind or path.suffix[1:].upper() or "a file"
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"cannot be read as {name} ({reason})") from error
        finally:
            _block.most = outer


def check_size(what: str, size: int, most: int | None = None) -> None:
    """Refuse to read, unpack or allocate more bytes than the block of `reading` may take."""
    limit = _most() if most is None else most
    if size > limit:
        raise InputError(f"{what} has {size} bytes, more than the limit of {limit}; split it")


def check_archive(members: zipfile.ZipFile) -> None:
    """Refuse an archive that unpacks to too much; a member never unpacks to more than it says."""
    check_size("its content", sum(entry.file_size for entry in members.infolist()))


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
