"""Every mesh file below a folder, found without asking the disk about each."""

import os
from collections import Counter
from collections.abc import Callable, Container, Sequence
from pathlib import Path
from typing import NamedTuple

from qs3.errors import InputError
from qs3.meshes.loading import EXTENSIONS

_MOST_LINKED = 100_000
"""Times that links may lead to a folder that was listed before: links between links multiply."""


class MeshFile(NamedTuple):
    """A mesh found below a root."""

    relative: str
    """Path below the root, with ``/`` on every system."""
    linked: bool
    """Whether the way there goes through a symbolic link, which may lead out of the root."""


def entries(folder: str | Path) -> list[os.DirEntry[str]]:
    """List a folder without what is hidden (a leading dot).

    Raises:
        InputError: where it cannot be read.
    """
    try:
        with os.scandir(folder) as listing:
            return [entry for entry in listing if not entry.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: cannot be listed ({error.strerror})") from error


def walk(
    root: Path, skip: Container[str] = (), others: Counter[str] | None = None
) -> list[MeshFile]:
    """Find the meshes at any depth; symbolic links are followed, circles of them left.

    Folders of ``skip`` right below the root are left out. ``others`` takes up how many other files
    there are of each ending.

    Raises:
        InputError: where a folder cannot be read, a link that is named like a mesh leads nowhere
            (a disk that is not there, say), or links lead to the same folders again and again.
    """
    meshes: list[MeshFile] = []
    seen: set[str] = set()
    again = 0
    # Of each folder still to be listed: its path below the root with a closing slash, whether a
    # link leads there, and the real paths from the root down to it, in which a circle shows.
    left: list[tuple[str, bool, tuple[str, ...]]] = [("", False, (os.path.realpath(root),))]
    while left:
        prefix, linked, above = left.pop()
        if linked:  # each folder of a large tree comes once; links between links bring it often
            again += above[-1] in seen
            seen.add(above[-1])
        if again > _MOST_LINKED:
            raise InputError(
                f"{root}: links lead to the same folders more than {_MOST_LINKED} times; name the "
                "folder of the meshes itself"
            )
        for entry in entries(root / prefix if prefix else root):
            if not prefix and entry.name in skip:
                continue
            is_link = entry.is_symlink()
            if _is(entry.is_dir, entry):
                real = os.path.realpath(entry.path) if is_link else f"{above[-1]}/{entry.name}"
                if real not in above:
                    left.append((f"{prefix}{entry.name}/", linked or is_link, (*above, real)))
                continue
            ending = os.path.splitext(entry.name)[1].lower()  # noqa: PTH122
            if ending in EXTENSIONS and is_file(entry):
                meshes.append(MeshFile(prefix + entry.name, linked or is_link))
            elif others is not None:
                others[ending or entry.name] += 1
    return meshes


def is_file(entry: os.DirEntry[str] | Path) -> bool:
    """Whether a path is a file.

    Raises:
        InputError: where it is a link that leads nowhere.
    """
    if _is(entry.is_file, entry):
        return True
    if entry.is_symlink():
        raise InputError(f"{os.fspath(entry)}: a link that leads to no file; mend or remove it")
    return False


def ids(files: Sequence[MeshFile]) -> list[str]:
    """Names of meshes: paths without ending; where two would be one, both keep their endings.

    Example:
        >>> ids([MeshFile(path, linked=False) for path in ("chair/a.off", "b.obj", "b.ply")])
        ['chair/a', 'b.obj', 'b.ply']
    """
    stems = [file.relative.rpartition(".")[0] for file in files]
    count = Counter(stems)
    paths = {file.relative for file in files}
    return [
        stem if count[stem] == 1 and stem not in paths else file.relative
        for stem, file in zip(stems, files, strict=True)
    ]


def _is(kind: Callable[[], bool], entry: os.DirEntry[str] | Path) -> bool:
    try:
        return kind()
    except OSError as error:
        raise InputError(f"{os.fspath(entry)}: cannot be read ({error.strerror})") from error
