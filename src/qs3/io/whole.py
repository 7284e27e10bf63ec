"""A folder, or a file, that appears whole under its name or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from qs3.errors import InputError
from qs3.files import LOCK, folder_lock, holds_something, sync_entry


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield a path of the same name to write to, which becomes ``path`` when the block ends well.

    It lies in a hidden folder beside ``path`` and is not there yet. What is written is synced to
    disk before the rename. On an exception the hidden folder is removed; a killed process leaves
    it behind, and the next run of the same name clears it.

    Args:
        path: A name that is free, or an empty folder.

    Raises:
        InputError: where ``path`` holds something, or another process writes it at this moment.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "data"
        >>> with whole(target) as temporary:
        ...     temporary.mkdir()
        ...     _ = (temporary / "a.txt").write_text("whole")
        >>> [file.name for file in target.iterdir()], len(list(target.parent.iterdir()))
        (['a.txt'], 1)
    """
    path = check_free(path)
    hidden = path.with_name(f".{path.name}.unfinished")
    hidden.mkdir(parents=True, exist_ok=True)
    with folder_lock(hidden):
        try:
            _clear(hidden)
            temporary = hidden / path.name
            yield temporary
            _sync(temporary)
            if path.is_dir():
                shutil.rmtree(path)
            temporary.replace(path)
            sync_entry(path.parent)
        finally:
            shutil.rmtree(hidden, ignore_errors=True)


def check_free(path: Path) -> Path:
    """Return a path with its links followed, if it is free to write to or an empty folder.

    Raises:
        InputError: where it holds something.
    """
    path = Path(path).resolve()
    if not path.name or (path.exists() and (not path.is_dir() or holds_something(path))):
        raise InputError(f"{path}: is there already; name a new or empty folder")
    return path


def _clear(folder: Path) -> None:
    for entry in folder.iterdir():
        if entry.name == LOCK:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _sync(path: Path) -> None:
    if path.is_file():
        sync_entry(path)
        return
    for folder, _, files in os.walk(path):
        for name in files:
            sync_entry(Path(folder) / name)
        sync_entry(Path(folder))
