"""What a reader and writer of one data set layout is."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from qs3.io.ragged import RaggedClouds


@dataclass(frozen=True)
class Format:
    """One layout of files on disk."""

    name: str
    """The word after ``--to`` and ``--from``."""
    layout: str
    """The layout in one line, for messages: what lies where."""
    detect: Callable[[Path], bool]
    """Whether a path looks like this layout; judges by names, reads no content."""
    read: Callable[[Path, str | None], RaggedClouds] | None = None
    """Read a path, all of it or one split; None where it is only written."""
    write: Callable[[Path, RaggedClouds], None] | None = None
    """Write clouds to a new path; None where it is only read."""
