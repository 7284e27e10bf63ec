"""The description of a data set layout."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from qs3.io.clouds import RaggedClouds

SPLITS = ("train", "test")
POINTS = 2048
"""Points a cloud, as most data sets of this field have them."""


@dataclass(frozen=True)
class Format:
    """One layout of files on disk."""

    name: str
    """Value of ``--to`` and ``--from``."""
    layout: str
    """The layout in one line, for messages."""
    detect: Callable[[Path], bool]
    """Return whether a path looks like this layout; judges by names, reads no content."""
    read: Callable[[Path, str | None], RaggedClouds]
    """Read a path, all of it or one split."""
    write: Callable[[Path, RaggedClouds], None] | None = None
    """Write clouds to a new path; None for a layout that is only read."""
    page: str = ""
    """Where to download the data set; empty for a layout of no particular data set."""
