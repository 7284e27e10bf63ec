"""The guard around every reader of a file: a regular file, bounded memory, errors of one line."""

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

from qs3.errors import InputError, QS3Error

MOST_BYTES = 8 << 30
"""Largest file that is read as a whole, and most memory that reading one may take."""

_BASE, _SHARE = 2 << 30, 32  # reading a file may take so many bytes, and times its size
_lock = threading.Lock()
_readers, _before = 0, (-1, -1)


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

    The block may take 2 GiB of memory and 32 times the size of the file, at most ``MOST_BYTES``.
    On Linux this limits the address space of the process (``RLIMIT_AS``); the last of several
    blocks that run at once lifts it. Do not ``yield`` to other code within the block.

    Args:
        path: The file.
        kind: Name of its format, for messages; by default its ending.
        streamed: Whether it is read piece by piece, so that it may be larger than ``MOST_BYTES``.
    """
    most = MOST_BYTES
    with naming(path):
        try:
            size = _size_of(path := Path(path))
            if not streamed:
                check_size("the file", size)
            most = min(_BASE + _SHARE * size, MOST_BYTES)
            with _memory_limit(most):
                yield
        except QS3Error:
            raise
        except PermissionError as error:
            raise InputError("cannot be read: no permission") from error
        except MemoryError as error:
            raise InputError(
                f"takes over {most / 2**30:.1f} GiB of memory to read; simplify or split it"
            ) from error
        except Exception as error:  # parsers of damaged files raise anything
            name = kind or path.suffix[1:].upper() or "a file"
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"cannot be read as {name} ({reason})") from error


def check_size(what: str, size: int) -> None:
    """Refuse to read or to unpack more than ``MOST_BYTES``."""
    if size > MOST_BYTES:
        raise InputError(f"{what} has {size} bytes, more than the limit of {MOST_BYTES}; split it")


def _size_of(path: Path) -> int:
    if not path.exists():
        raise InputError("no such file")
    if not path.is_file():
        raise InputError("is a folder; name a file" if path.is_dir() else "is not a regular file")
    if not (size := path.stat().st_size):
        raise InputError("the file is empty")
    path.open("rb").close()  # some parsers call a file without permission missing
    return size


@contextlib.contextmanager
def _memory_limit(most: int) -> Iterator[None]:
    """Let this process take ``most`` bytes more than it has now."""
    global _readers, _before
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except (ImportError, OSError):  # not Linux
        yield
        return
    with _lock:
        now, hard = resource.getrlimit(resource.RLIMIT_AS)
        if not _readers:
            _before = now, hard
        least = now if _readers else 0  # another block that runs still needs as much
        wanted = max(least, pages * resource.getpagesize() + most)
        finite = [bound for bound in (wanted, *_before) if bound != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(finite), hard))
        _readers += 1
    try:
        yield
    finally:
        with _lock:
            _readers -= 1
            if not _readers:
                resource.setrlimit(resource.RLIMIT_AS, _before)
