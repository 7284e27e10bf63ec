"""Which layout a path is in, judged by names, and layouts by name."""

import difflib
from pathlib import Path

from qs3.errors import InputError
from qs3.files import holds_something
from qs3.io.layouts import FORMATS, FORMER_NAMES, Format
from qs3.io.layouts.point_folders import FORMATS as _PLAIN

# Plain folders fit much that has a name of its own; they count where nothing else does.
_GENERAL = tuple(layout.name for layout in _PLAIN)


def detect(path: Path) -> Format:
    """Return the one layout that a path looks like; plain folders only where no other fits.

    Raises:
        InputError: where the path is missing or empty, or fits no layout or several; they are
            listed.
    """
    path = Path(path)
    require(path)
    fits = [layout for layout in FORMATS.values() if layout.detect(path)]
    fits = [layout for layout in fits if layout.name not in _GENERAL] or fits
    if len(fits) == 1:
        return fits[0]
    if not fits:
        names = "; ".join(f"{layout.name}: {layout.layout}" for layout in FORMATS.values())
        raise InputError(f"{path}: looks like no layout that is known; these are: {names}")
    several = "; ".join(f"--from {layout.name}: {layout.layout}" for layout in fits)
    raise InputError(f"{path}: could be several layouts; say which: {several}")


def format_named(name: str) -> Format:
    """Return a layout by its name.

    Raises:
        InputError: where there is none; the nearest name and all names are told.
    """
    name = FORMER_NAMES.get(name, name)
    if name in FORMATS:
        return FORMATS[name]
    near = difflib.get_close_matches(name, FORMATS, n=1)
    meant = f"; did you mean {near[0]}?" if near else ""
    raise InputError(f"{name!r} is no known layout ({', '.join(FORMATS)}){meant}")


def require(path: Path, layout: Format | None = None) -> None:
    """Refuse a path that is missing or empty; where the data set is known, tell where it is got.

    Args:
        path: What is to be read.
        layout: Layout that it shall be in; None where it is to be found out.

    Raises:
        InputError: where nothing is there.
    """
    if path.is_file() or holds_something(path):
        return
    what = "an empty folder" if path.is_dir() else "no such file or folder"
    if layout is not None and layout.page:
        what += f"; get it from {layout.page} and unpack it; expected: {layout.layout}"
    raise InputError(f"{path}: {what}")
