"""Which layout a path is in, judged by names, and layouts by name."""

import difflib
from collections.abc import Sequence
from pathlib import Path

from qs3.errors import InputError
from qs3.files import holds_something
from qs3.io.downloads import where_to_get
from qs3.io.layouts import FORMATS, Format
from qs3.io.layouts.point_folders import FORMATS as _PLAIN
from qs3.io.ragged import RaggedClouds

# Plain folders fit much that has a name of its own; they count where nothing else does.
_GENERAL = tuple(layout.name for layout in _PLAIN)


def detect(path: Path) -> Format:
    """Return the one readable layout that a path looks like.

    Raises:
        InputError: where the path is missing or empty, or fits no layout or several; they are
            listed.
    """
    path = Path(path)
    require(path)
    return one_of(path, matching(path))


def one_of(path: Path, fits: Sequence[Format]) -> Format:
    """Return the one layout that fits.

    Raises:
        InputError: where none or several fit.
    """
    if len(fits) == 1:
        return fits[0]
    if not fits:
        known = "; ".join(f"{f.name}: {f.layout}" for f in FORMATS.values() if f.read is not None)
        raise InputError(f"{path}: looks like no layout that is known; these are: {known}")
    several = "; ".join(f"--from {layout.name}: {layout.layout}" for layout in fits)
    raise InputError(f"{path}: could be several layouts; say which: {several}")


def matching(path: Path) -> list[Format]:
    """Return every readable layout that a path looks like; plain folders only where no other."""
    fits = [f for f in FORMATS.values() if f.read is not None and f.detect(path)]
    return [layout for layout in fits if not is_general(layout)] or fits


def is_general(layout: Format) -> bool:
    """Whether a layout is a plain folder of point files, whose classes carry any names."""
    return layout.name in _GENERAL


def read_as(layout: Format, path: Path, split: str | None) -> RaggedClouds:
    """Read a path in a layout.

    Raises:
        InputError: where the layout is only written, or the path is not in it or damaged.
    """
    if layout.read is None:
        raise InputError(f"{layout.name}: is only written; name another layout to read")
    return layout.read(path, split)


def format_named(name: str) -> Format:
    """Return a layout by its name.

    Raises:
        InputError: where there is none; the nearest name and all names are told.
    """
    if name in FORMATS:
        return FORMATS[name]
    near = difflib.get_close_matches(name, FORMATS, n=1)
    meant = f"; did you mean {near[0]}?" if near else ""
    raise InputError(f"{name!r} is no known layout ({', '.join(FORMATS)}){meant}")


def require(path: Path, name: str = "") -> None:
    """Refuse a path that is missing or empty; where the data set is known, tell where it is got.

    Args:
        path: What is to be read.
        name: Layout that it shall be in; empty where it is to be found out.

    Raises:
        InputError: where nothing is there.
    """
    if path.is_file() or holds_something(path):
        return
    what = "an empty folder" if path.is_dir() else "no such file or folder"
    told = where_to_get(name)
    raise InputError(f"{path}: {what}" + (f"; {told}" if told else ""))
