"""Every mesh file below a folder."""

import os
from collections import Counter
from collections.abc import Container, Iterator, Sequence
from pathlib import Path

from qs3.errors import InputError
from qs3.meshes.loading import EXTENSIONS


def entries(folder: str | Path) -> list[os.DirEntry[str]]:
    """List a folder without what is hidden (a leading dot)."""
    try:
        with os.scandir(folder) as listing:
            return [entry for entry in listing if not entry.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: cannot be listed ({error.strerror})") from error


def walk(root: Path, skip: Container[str] = (), others: Counter[str] | None = None) -> list[str]:
    """Find the meshes at any depth; return their paths below the root, with ``/``.

    Symbolic links are followed, except in circles.

    Args:
        root: Folder to search.
        skip: Folders right below the root to leave out.
        others: Counts other files, by their endings.
    """
    return list(_walk(root, "", (os.path.realpath(root),), skip, others))


def _walk(
    root: Path,
    prefix: str,
    above: tuple[str, ...],
    skip: Container[str],
    others: Counter[str] | None,
) -> Iterator[str]:
    """Walk one folder; ``above`` are the real paths from the root down to it."""
    for entry in entries(root / prefix):
        if entry.is_dir():
            real = os.path.realpath(entry.path)
            if entry.name not in skip and real not in above:
                yield from _walk(root, f"{prefix}{entry.name}/", (*above, real), (), others)
            continue
        ending = os.path.splitext(entry.name)[1].lower()  # noqa: PTH122
        if ending in EXTENSIONS and is_file(entry):
            yield prefix + entry.name
        elif others is not None:
            others[ending or entry.name] += 1


def is_file(entry: os.DirEntry[str] | Path) -> bool:
    """Return whether a path is a file."""
    if not entry.is_file() and entry.is_symlink():
        raise InputError(f"{os.fspath(entry)}: a link that leads to no file; mend or remove it")
    return entry.is_file()


def ids(files: Sequence[str]) -> list[str]:
    """Return names of meshes: paths without ending, unless two would be equal.

    Example:
        >>> ids(["chair/a.off", "b.obj", "b.ply"])
        ['chair/a', 'b.obj', 'b.ply']
    """
    stems = [file.rpartition(".")[0] for file in files]
    count = Counter(stems)
    paths = set(files)
    return [
        stem if count[stem] == 1 and stem not in paths else file
        for stem, file in zip(stems, files, strict=True)
    ]
