"""The description of a data set layout."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from qs3.io.clouds import RaggedClouds

SPLITS = ("train", "test")


@dataclass(frozen=True)
class Format:
    """One layout of files on disk."""

    name: str
    layout: str
    detect: Callable[[Path], bool]
    """Return whether a path looks like this layout; judges by names, reads no content."""
    read: Callable[[Path, str | None], RaggedClouds]
    write: Callable[[Path, RaggedClouds], None] | None = None
    """Write clouds to a new path; None for a layout that is only read."""
