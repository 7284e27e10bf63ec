"""Files and folders written whole or not at all, one lock, strict JSON, checksums."""

import contextlib
import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from qs3.errors import InputError, StorageError
from qs3.reading import reading

LOCK = ".lock"
"""Name of the lock file in a folder; it may stay there, unlocked."""

_LEFT_OVER = re.compile(r"\.[0-9a-f]{16}\.tmp(\.\w+)?")
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path that becomes ``path`` when the block ends well.

    The bytes are synced to disk before the rename, so that after a power cut the file is either
    the old one or the whole new one. A link stays and its file is replaced; a device, a pipe or an
    open stream (``/dev/stdout``) gets the bytes. A full disk raises StorageError.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with atomic_path(Path(folder) / "a.txt") as temporary:
        ...         _ = temporary.write_text("whole")
        ...     (Path(folder) / "a.txt").read_text()
        'whole'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    ending = path.suffix if len(path.suffix) < 16 else ""  # some writers go by it
    name = f".{secrets.token_hex(8)}.tmp{ending}"
    streamed = _is_stream(path)
    place = Path(tempfile.gettempdir()) / name if streamed else path.resolve()
    temporary = place.with_name(name)
    try:
        with _disk_faults(path, temporary):
            yield temporary
            if streamed:
                with temporary.open("rb") as made, path.open("ab") as stream:
                    shutil.copyfileobj(made, stream)
                return
            _sync(temporary)
            temporary.replace(place)
            with contextlib.suppress(OSError):  # some file systems sync no folders
                _sync(place.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _is_stream(path: Path) -> bool:
    """Whether a path is a device, a pipe, a socket, or an open file of a process."""
    target = path.parent / path.readlink() if path.is_symlink() else path
    opened = target.parent.resolve().is_relative_to("/proc")
    return path.exists() and not path.is_dir() and (opened or not path.is_file())


def allowed(path: Path, mode: int) -> bool:
    """Whether this process has a permission, such as ``os.R_OK``."""
    return os.access(path, mode, effective_ids=os.access in os.supports_effective_ids)


def check_output(path: Path, option: str, *endings: str) -> Path:
    """Return the path of a file to write, before anything is computed for it.

    Raises:
        InputError: if it cannot be written, or is a file with content that ends in none of
            ``endings`` or is binary where text goes.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; name a file")
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir():
        raise InputError(f"{option} {path}: {parent} is a file; name a file in a folder")
    if _is_stream(path):
        return path
    if not allowed(parent, os.W_OK | os.X_OK) or (path.exists() and not allowed(path, os.R_OK)):
        raise InputError(f"{option} {path}: no permission to write it; name another file")
    head = b""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(512)
    ending = path.suffix.lower()
    if head and (ending not in endings or (b"\0" in head and ending not in (".png", ".onnx"))):
        raise InputError(
            f"{option} {path}: is there already and may be a cloud or other data; name a new "
            f"file, or one that ends in {' or '.join(endings)}"
        )
    return path


@contextlib.contextmanager
def _disk_faults(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Name ``path`` in an error of writing, and say what to do about a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise StorageError(
                f"{path}: cannot be written ({error.strerror}); make room there and run the same "
                "command again"
            ) from error
        if error.filename is None or Path(error.filename) == temporary:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield the path of a folder to make, which becomes ``path`` when the block ends well.

    Raises:
        InputError: if ``path`` is a file or a folder with content, at the beginning or at the end,
            or another process makes it at this moment.
    """
    path = Path(path).resolve()
    refuse_taken(path)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.mkdir(parents=True, exist_ok=True)
    with folder_lock(temporary), _disk_faults(path):
        try:
            whole = temporary / path.name  # some layouts go by it
            if whole.exists():  # left by a killed process
                shutil.rmtree(whole)
            yield whole
            for inner, _, files in os.walk(whole):
                for entry in files:
                    _sync(Path(inner) / entry)
            refuse_taken(path)
            if path.is_dir():
                shutil.rmtree(path)
            whole.rename(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def folder_lock(path: Path) -> Iterator[None]:
    """Keep a second process from writing into a folder; a killed one releases it."""
    import filelock

    lock = filelock.FileLock(Path(path) / LOCK)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        raise InputError(
            f"{path}: another qs3 is writing into this folder; wait for it, or name another one"
        ) from None
    try:
        yield
    finally:
        lock.release()


def _sync(path: Path) -> None:
    """Bring a file, or the names in a folder, to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as `json_bytes` to ``path`` atomically."""
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

    Example:
        >>> parse_json(b'{"a": [1, 2]}', "a.json")
        {'a': [1, 2]}
    """
    try:
        return json.loads(data, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError and JSONDecodeError too
        raise InputError(f"{where}: not a JSON file ({str(error)[:200]})") from error


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is no number of JSON")


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal text."""
    with Path(path).open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def describe_others(others: Mapping[str, int]) -> str:
    """Count skipped files by their endings in one line, such as ``3 .csv, 1 .npz``."""
    return ", ".join(f"{count} {ending}" for ending, count in sorted(others.items()))


def holds_something(path: Path) -> bool:
    """Return whether ``path`` is a folder with content, other than a lock or an unfinished file."""
    return path.is_dir() and any(
        entry.name != LOCK and not _LEFT_OVER.fullmatch(entry.name) for entry in path.iterdir()
    )


def refuse_taken(path: Path) -> None:
    """Refuse the path of a new folder if it is a file, or a folder that is not empty."""
    path = Path(path).resolve()
    if not path.name or (path.exists() and (not path.is_dir() or holds_something(path))):
        raise InputError(f"{path}: is there already; name a new or empty folder")


def remove_left_overs(path: Path) -> None:
    """Remove the unfinished files of killed processes; nobody else may be writing there."""
    for entry in Path(path).iterdir():
        if _LEFT_OVER.fullmatch(entry.name):
            entry.unlink()


def claim_folder(path: Path, marker: str) -> Path:
    """Return an output folder: made if absent, accepted if empty or ours.

    Args:
        path: The folder that the user named.
        marker: Name of the file that shows that an earlier run of the same command made it.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; name a folder for --out")
    if holds_something(path) and not (path / marker).is_file():
        raise InputError(f"{path}: holds something else (no {marker}); name a new or empty folder")
    path.mkdir(parents=True, exist_ok=True)
    return path
