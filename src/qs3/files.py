"""Files written whole or not at all, fresh temporary folders, locks, strict JSON, checksums."""

import contextlib
import errno
import glob
import hashlib
import json
import math
import os
import re
import secrets
import shutil
import socket
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from qs3.errors import InputError, StorageError

LOCK = ".lock"
"""Name of the file that tells who writes into a folder; it is there only meanwhile."""

_LEFT_OVER = re.compile(r"\..+\.(\d+|[0-9a-f]{8})\.tmp(\.\w+)?$")
_SUSPECT = re.compile(r"\\u[dD][89a-fA-F]")
"""What halves of surrogate pairs look like in JSON."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LONGEST_STEM = 100  # bytes of a name that go into a temporary one; the longest name may have 143


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that becomes ``path`` when the block ends well.

    The bytes are synced to disk before the rename, so that after a power cut the file is either
    the old one or the whole new one. On an exception the temporary file is removed.

    Raises:
        StorageError: where the disk is full; ``path`` is named.

    Example:
        >>> with temporary_folder(Path(tempfile.gettempdir()) / "example") as folder:
        ...     with atomic_path(folder / "a.txt") as temporary:
        ...         _ = temporary.write_text("whole")
        ...     (folder / "a.txt").read_text()
        'whole'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # A random name: nobody can have put a link there to lead the write elsewhere.
    ending = path.suffix if len(path.suffix) < 16 else ""  # some writers go by it
    temporary = path.with_name(f".{_stem(path)}.{secrets.token_hex(4)}.tmp{ending}")
    try:
        with _faults_named(path, temporary):
            yield temporary
            sync_entry(temporary)
            temporary.replace(path)
            with contextlib.suppress(OSError):  # some file systems sync no folders
                sync_entry(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def temporary_folder(path: Path, alone: bool = False) -> Iterator[Path]:
    """Yield a fresh folder beside ``path``, removed with all that is in it at the end.

    Its name is random: no folder that is there already is taken for it, and no link followed. It
    holds nothing but its lock. What a killed process left behind for the same ``path`` is removed.

    Raises:
        InputError: where another process has such a folder at this moment, and ``alone`` is asked.
    """
    path = Path(path).absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    for entry in path.parent.glob(f".{glob.escape(_stem(path))}.????????.tmp"):
        if (entry / LOCK).is_file() and not entry.is_symlink():
            others = contextlib.nullcontext() if alone else contextlib.suppress(InputError)
            with others, folder_lock(entry):  # nobody's any more
                shutil.rmtree(entry, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{_stem(path)}.", suffix=".tmp", dir=path.parent))
    try:
        with folder_lock(folder):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield the path of a folder to make, which becomes ``path`` when the block ends well.

    Raises:
        InputError: where ``path`` is there already and no empty folder, at the beginning or at the
            end: what has come meanwhile stays, and what was made goes.
        StorageError: where the disk is full; ``path`` is named.
    """
    path = Path(path).resolve()
    refuse_taken(path)
    with temporary_folder(path, alone=True) as folder, _faults_named(path):
        whole = folder / path.name  # some layouts go by it
        yield whole
        for inner, _, files in os.walk(whole):
            for entry in (*files, ""):
                sync_entry(Path(inner) / entry)
        if path.is_dir():
            with folder_lock(path):
                remove_left_overs(path)
            if any(path.iterdir()):
                raise InputError(
                    f"{path}: was empty, but something has come meanwhile, which is left as it "
                    "is; nothing was written, name a new or empty folder and run it again"
                )
            path.rmdir()
        whole.rename(path)
    sync_entry(path.parent)


@contextlib.contextmanager
def _faults_named(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Put the file's name into an error of writing; a full disk is told with what to do."""
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


def _stem(path: Path) -> str:
    """The name of a path, as much of it as leaves room for a mark within the longest name."""
    return os.fsencode(path.name)[:_LONGEST_STEM].decode(errors="ignore")


@contextlib.contextmanager
def folder_lock(path: Path) -> Iterator[None]:
    """Keep a second process from writing into a folder; a killed one lets go.

    The system's own lock on the file ``.lock``, which names process and machine. Where a file
    system has none, that name decides: a process of this machine that has ended lets go.

    Raises:
        InputError: where another process holds it; process and machine are named.
    """
    file = Path(path) / LOCK
    handle = _open_lock(file)
    try:
        with _faults_named(file):
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        yield
    finally:
        file.unlink(missing_ok=True)
        os.close(handle)


def _open_lock(file: Path) -> int:
    """Open and lock a file that nobody else holds."""
    while True:
        refuse_link(file)
        handle = os.open(file, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            _lock(handle, file)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), file.stat()):
                    return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # it was let go, and its file removed, since we opened it


def _lock(handle: int, file: Path) -> None:
    holder = os.read(handle, 200).decode(errors="replace")
    try:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    except ImportError:  # Windows
        return
    except BlockingIOError:
        advice = "wait for it, or name another one"
    except OSError:  # a file system without locks
        if _has_ended(holder):
            return
        advice = f"wait for it or, if it has ended, remove {file}"
    by = f" ({holder})" if holder else ""
    raise InputError(f"{file.parent}: another qs3 is writing into this folder{by}; {advice}")


def _has_ended(holder: str) -> bool:
    """Whether the process that a lock names is gone for certain."""
    process, _, machine = holder.removeprefix("process ").partition(" on ")
    if machine != socket.gethostname() or not process.isdigit():
        return not holder
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, OverflowError):
        return True
    except PermissionError:
        return False
    return int(process) == os.getpid()  # ours since it was started: that one has ended


def sync_entry(path: Path) -> None:
    """Bring a file, or the names in a folder, to disk."""
    if os.name == "nt" and path.is_dir():  # Windows opens no folder
        return
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
    """Write ``value`` as indented JSON atomically; NaN and infinity are refused (not JSON)."""
    write_bytes(path, json_bytes(value))


def json_bytes(value: Any) -> bytes:
    """Return ``value`` as indented JSON; NaN and infinity are refused (not JSON)."""
    text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
    return f"{text}\n".encode()


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: where the file is missing or is not JSON.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    return parse_json(path.read_bytes(), path)


def parse_json(data: bytes | str, where: str | Path) -> Any:
    """Read JSON text, strictly: what comes back can be written again as JSON in UTF-8.

    So no NaN, no infinity (1e999), no half of a surrogate pair, no whole number of thousands of
    digits; nor is a file read that is nested deeper than Python goes.

    Raises:
        InputError: where it is not such JSON; ``where`` heads the message.

    Example:
        >>> parse_json(b'{"a": [1, 2]}', "a.json")
        {'a': [1, 2]}
    """
    try:
        text = data.decode() if isinstance(data, bytes) else data.encode().decode()
        value = json.loads(text, parse_constant=_refuse, parse_float=_finite)
        if _SUSPECT.search(text):
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except RecursionError:
        raise InputError(f"{where}: not a JSON file (nested too deep)") from None
    except ValueError as error:  # UnicodeDecodeError and JSONDecodeError among them
        raise InputError(f"{where}: not a JSON file ({str(error)[:200]})") from error


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is no number of JSON")


def _finite(word: str) -> float:
    number = float(word)
    if math.isinf(number):
        raise ValueError(f"{word[:40]} is too large a number")
    return number


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal text."""
    with Path(path).open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def describe_others(others: Mapping[str, int]) -> str:
    """Tell how many files of each ending were passed over; empty where none was.

    Example:
        >>> describe_others({".npz": 1, ".csv": 3})
        '3 .csv, 1 .npz'
    """
    return ", ".join(f"{count} {ending}" for ending, count in sorted(others.items()))


def holds_something(path: Path) -> bool:
    """Whether ``path`` is a folder with content, left-overs of an interrupted write aside."""
    return path.is_dir() and any(
        entry.name != LOCK and not _LEFT_OVER.match(entry.name) for entry in path.iterdir()
    )


def refuse_taken(path: Path) -> None:
    """Refuse a folder to make where something is already.

    Raises:
        InputError: where ``path`` is a file, or a folder that is not empty.
    """
    path = Path(path).resolve()
    if not path.name or (path.exists() and (not path.is_dir() or holds_something(path))):
        raise InputError(f"{path}: is there already; name a new or empty folder")


def remove_left_overs(path: Path) -> None:
    """Remove what interrupted writes left in a folder; nobody else may be writing there."""
    for entry in Path(path).iterdir():
        if _LEFT_OVER.match(entry.name) and entry.is_file():
            entry.unlink()


def refuse_link(path: Path) -> None:
    """Refuse a link where a file or folder of ours belongs: it leads to somebody else's.

    Raises:
        InputError: where it is one.
    """
    if path.is_symlink():
        raise InputError(f"{path}: is a link, which qs3 does not follow; remove it")


def sub_folder(path: Path) -> Path:
    """Return a folder of ours within another, made if absent.

    Raises:
        InputError: where it is a link: what is written there would land elsewhere.
    """
    refuse_link(path)
    path.mkdir(parents=True, exist_ok=True)
    return path


def claim_folder(path: Path, marker: str) -> Path:
    """Return ``path`` as an output folder: made if absent, accepted if empty or ours.

    Args:
        path: The folder the user named.
        marker: Name of the file that shows that an earlier run of the same command made it.

    Raises:
        InputError: where it is a file, or a folder that holds something else.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; name a folder for --out")
    if holds_something(path) and not (path / marker).is_file():
        raise InputError(f"{path}: holds something else (no {marker}); name a new or empty folder")
    path.mkdir(parents=True, exist_ok=True)
    return path
