"""Files written whole or not at all, and checksums."""

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from qs3.errors import InputError

_LEFT_OVER = re.compile(r"\..+\.\d+\.tmp(\.\w+)?$")


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that becomes ``path`` when the block ends well.

    The bytes are synced to disk before the rename, so that after a power cut the file is either
    the old one or the whole new one. On an exception the temporary file is removed.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "a.txt"
        >>> with atomic_path(target) as temporary:
        ...     _ = temporary.write_text("whole")
        >>> target.read_text()
        'whole'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as handle:
            os.fsync(handle.fileno())
        temporary.replace(path)
        with contextlib.suppress(OSError):  # some file systems sync no folders
            sync_entry(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


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
    write_text(path, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


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
    """Read JSON text, strictly: no NaN, no infinity, no whole number of thousands of digits.

    Raises:
        InputError: where it is not such JSON; ``where`` heads the message.

    Example:
        >>> parse_json(b'{"a": [1, 2]}', "a.json")
        {'a': [1, 2]}
    """
    try:
        text = data.decode("utf-8") if isinstance(data, bytes) else data
        return json.loads(text, parse_constant=_refuse)
    except RecursionError:
        raise InputError(f"{where}: not a JSON file (nested too deep)") from None
    except ValueError as error:  # UnicodeDecodeError and JSONDecodeError among them
        raise InputError(f"{where}: not a JSON file ({str(error)[:200]})") from error


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is no number of JSON")


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal text."""
    with Path(path).open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def holds_something(path: Path) -> bool:
    """Whether ``path`` is a folder with content, left-overs of an interrupted write aside."""
    return path.is_dir() and any(not _LEFT_OVER.match(entry.name) for entry in path.iterdir())


def remove_left_overs(path: Path) -> None:
    """Remove what interrupted writes left in a folder; nobody else may be writing there."""
    for entry in Path(path).iterdir():
        if _LEFT_OVER.match(entry.name) and entry.is_file():
            entry.unlink()


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
