"""Files and folders written whole or not at all, one lock, strict JSON, checksums."""

import contextlib
import errno
import hashlib
import itertools
import json
import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from qs3.errors import InputError, StorageError
from qs3.reading import reading

LOCK = ".lock"
"""Name of the lock file in a folder; it may stay there, unlocked."""

_PAGE = b"Content-Security-Policy\" content=\"default-src 'none'; "
"""In the head of every page of ours."""
_SHORT, _LONG = 0.02, 2.0  # steps in seconds of the clocks of disks; the long one counts seconds
_UNSEEN = itertools.count()
_LEFT_OVER = re.compile(r"\.[0-9a-f]{16}\.tmp(\.\w+)?")


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` at once; after a power cut the file is the old or the new one.

    A link stays and its file is replaced; a device, a pipe or an open stream (``/dev/stdout``) gets
    the bytes. A full disk raises StorageError.
    """
    path = Path(path)
    place = resolved(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = place.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        if _is_stream(path):
            with path.open("ab") as stream:
                stream.write(data)
            return
        temporary.write_bytes(data)
        _sync(temporary)
        temporary.replace(place)
        _sync(place.parent)
    except OSError as error:
        _raise_full(path, error)
        error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _raise_full(path: Path, error: OSError) -> None:
    """Raise StorageError if the disk is full."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        fix = "make room there and run the same command again"
        raise StorageError(f"{path}: cannot be written ({error.strerror}); {fix}") from error


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8, like `write_bytes`."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write `json_bytes`, like `write_bytes`."""
    write_bytes(path, json_bytes(value))


def json_bytes(value: Any) -> bytes:
    """Return ``value`` as indented JSON; NaN and infinity are refused (not JSON)."""
    text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
    return f"{text}\n".encode()


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    with reading(path, "JSON"):
        return parse_json(Path(path).read_bytes(), path)


def parse_json(data: bytes | str, where: str | Path) -> Any:
    """Read JSON text; raises InputError, headed by ``where``, for NaN, infinity or other text.

    So it does for a name that has two values.
    """
    try:
        return json.loads(data, parse_constant=_refuse, object_pairs_hook=table_of)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError and JSONDecodeError too
        raise InputError(f"{where}: not a JSON file ({str(error)[:200]})") from error


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is no number of JSON")


def table_of(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return names and values as a table; raises ValueError if a name has two values."""
    table = dict(pairs)
    for name, value in pairs if len(table) < len(pairs) else ():
        if table[name] != value:
            raise ValueError(f"{name!r} has two values; remove one")
    return table


def write_arrays(path: Path, arrays: Mapping[str, Any], facts: Mapping[str, Any]) -> None:
    """Write NumPy arrays and JSON facts as one safetensors file, like `write_bytes`."""
    import safetensors.numpy

    text = json.dumps(facts, allow_nan=False)
    write_bytes(path, safetensors.numpy.save(dict(arrays), {"qs3": text}))


@contextlib.contextmanager
def open_arrays(path: Path, kind: str = "a safetensors file of qs3") -> Iterator[tuple[Any, Any]]:
    """Yield a safetensors file, of which nothing is read yet, and its facts; as `reading` does."""
    import safetensors

    with (
        reading(path, kind),
        safetensors.safe_open(path, framework="numpy") as handle,  # pyright: ignore[reportPrivateImportUsage]
    ):
        yield handle, parse_json((handle.metadata() or {})["qs3"], path)


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal text."""
    with Path(path).open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def state_of(path: Path) -> tuple[int, ...]:
    """Return what changes if a file does: what was read of it may be kept for as long.

    The clocks of disks stand still for some milliseconds, of a few for two seconds: a change in
    that time cannot be seen. Of a file that has just changed it waits once for these milliseconds;
    if a change may still go unseen, no other state is the same.
    """
    now = path.stat()
    if 0 < (left := _unseen(now)) <= _SHORT:
        time.sleep(left)
        now = path.stat()
    state = now.st_dev, now.st_ino, now.st_size, now.st_mtime_ns, now.st_ctime_ns
    return (*state, next(_UNSEEN)) if _unseen(now) else state


def _unseen(now: os.stat_result) -> float:
    """Return for how many seconds more a change of a file may leave its times as they are."""
    step = _SHORT if now.st_ctime_ns % 1_000_000_000 else _LONG
    # Both times: one may be set by hand, and on Windows the other is that of the file's birth.
    ages = [(time.time_ns() - changed) / 1e9 for changed in (now.st_mtime_ns, now.st_ctime_ns)]
    return max((step - age for age in ages if 0 <= age < step), default=0.0)


def check_output(path: Path, option: str, *endings: str) -> None:
    """Refuse a file that cannot be written, before anything is computed for it.

    A file with content must end in one of ``endings``: it may be a cloud.
    """
    path = Path(path)
    resolved(path)
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; name a file")
    if _is_stream(path):
        return
    try:
        _try_to_write(path.absolute().parent)
        is_taken = path.exists() and path.stat().st_size > 0
    except OSError as error:
        fault = f"cannot be written there ({error.strerror})"
        raise InputError(f"{option} {path}: {fault}; name another file") from error
    if is_taken and path.suffix.lower() not in endings:
        raise InputError(
            f"{option} {path}: is there already and may be a cloud or other data; name a new "
            f"file, or one that ends in {' or '.join(endings)}"
        )


def is_page(path: Path) -> bool:
    """Return whether a file is a page that qs3 wrote."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _PAGE in file.read(1 << 12)


def _try_to_write(folder: Path) -> None:
    """Write and remove a file in a folder, or in the first of its parents that is there."""
    nearest = next(place for place in (folder, *folder.parents) if place.exists())
    tempfile.TemporaryFile(dir=nearest).close()


def resolved(path: Path) -> Path:
    """Return the absolute path without links; a link that leads to itself is refused."""
    whole = Path(os.path.realpath(path))  # Path.resolve() raises or not, by the Python
    if any(place.is_symlink() for place in (whole, *whole.parents)):
        raise InputError(f"{path}: is a link that leads back to itself; remove it")
    return whole


def _is_stream(path: Path) -> bool:
    """Whether a path is a device, a pipe, a socket, or an open file of a process."""
    target = path.parent / path.readlink() if path.is_symlink() else path
    opened = resolved(target.parent).is_relative_to("/proc")
    return path.exists() and not path.is_dir() and (opened or not path.is_file())


def _sync(path: Path) -> None:
    """Bring a file, or the names in a folder, to disk."""
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError:
        if not path.is_dir():  # some folders cannot be opened, or are on a disk that syncs none
            raise


@contextlib.contextmanager
def new_folder(path: Path, *, over: bool = False) -> Iterator[Path]:
    """Yield the path of a folder to make, which becomes ``path`` when the block ends well.

    With ``over`` it takes the place of what is there, which stays as it is if anything fails.
    """
    named, path = path, resolved(path)
    if not over:
        refuse_taken(named)
    temporary = path.with_name(f".{path.name}.tmp")
    whole = temporary / path.name  # some layouts go by it
    before = temporary / ".before"
    temporary.mkdir(parents=True, exist_ok=True)
    with folder_lock(temporary):
        try:
            if before.exists() and not path.exists():  # killed between the two renames
                before.rename(path)
            for left in (whole, before):  # by a killed process
                if left.exists():
                    shutil.rmtree(left)
            yield whole
            for entry in (whole, *whole.rglob("*")):
                _sync(entry)
            try:
                if over and path.exists():
                    path.rename(before)
                _refuse_filled(path)
                if path.is_dir():
                    shutil.rmtree(path)
                whole.rename(path)
            except BaseException:
                if before.exists() and not path.exists():
                    before.rename(path)
                raise
            shutil.rmtree(before, ignore_errors=True)
            _sync(path.parent)
        except OSError as error:
            _raise_full(named, error)
            raise
        finally:
            if not before.exists():
                shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def folder_lock(path: Path) -> Iterator[None]:
    """Keep a second process from writing into a folder; a killed one releases it."""
    import filelock

    try:
        held = filelock.FileLock(Path(path) / LOCK).acquire(blocking=False)
    except filelock.Timeout:
        fault = "another qs3 is writing into this folder; wait for it, or name another one"
        raise InputError(f"{path}: {fault}") from None
    with held:
        yield


def holds_something(path: Path) -> bool:
    """Return whether ``path`` is a folder with content, other than a lock or an unfinished file."""
    return path.is_dir() and any(
        entry.name != LOCK and not _LEFT_OVER.fullmatch(entry.name) for entry in path.iterdir()
    )


def refuse_taken(path: Path) -> None:
    """Refuse the path of a new folder if it cannot be made, is a file, or is not empty."""
    _refuse_filled(resolved(path))
    check_folder(path)


def _refuse_filled(path: Path) -> None:
    if not path.name or (path.exists() and (not path.is_dir() or holds_something(path))):
        raise InputError(f"{path}: is there already; name a new or empty folder")


def check_folder(path: Path) -> None:
    """Refuse a folder in which nothing can be written, before anything is computed for it."""
    try:
        _try_to_write(resolved(path))
    except OSError as error:
        fault = f"cannot be written there ({error.strerror}); name another folder"
        raise InputError(f"{path}: {fault}") from error


def claim_folder(path: Path, marker: str, *, make: bool = True) -> Path:
    """Make an output folder, or accept one that is empty or has our file ``marker``.

    Without ``make`` it is only checked, before anything is computed for it.
    """
    path = Path(path)
    if not resolved(path).exists() and path.is_symlink():
        raise InputError(f"{path}: is a link to {path.readlink()}, which is not there; remove it")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; name a folder for --out")
    if holds_something(path) and not (path / marker).is_file():
        raise InputError(f"{path}: holds something else (no {marker}); name a new or empty folder")
    check_folder(path)
    if make:
        path.mkdir(parents=True, exist_ok=True)
    return path


def remove_left_overs(path: Path) -> None:
    """Remove the unfinished files of killed processes; nobody else may be writing there."""
    for entry in Path(path).iterdir():
        if _LEFT_OVER.fullmatch(entry.name):
            entry.unlink()


def describe_others(others: Mapping[str, int]) -> str:
    """Count skipped files by their endings in one line, such as ``3 .csv, 1 .npz``."""
    return ", ".join(f"{count} {ending}" for ending, count in sorted(others.items()))
