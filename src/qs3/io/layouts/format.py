"""What a reader and writer of one data set layout is, and what several of them check."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from qs3.errors import InputError
from qs3.io.clouds import RaggedClouds
from qs3.meshes.classes import map_labels

SPLITS = ("train", "test")
POINTS = 2048
"""Points a cloud, as most data sets of this field have them."""


@dataclass(frozen=True)
class Format:
    """One layout of files on disk."""

    name: str
    """The word after ``--to`` and ``--from``."""
    layout: str
    """The layout in one line, for messages: what lies where."""
    detect: Callable[[Path], bool]
    """Whether a path looks like this layout; judges by names, reads no content."""
    read: Callable[[Path, str | None], RaggedClouds]
    """Read a path, all of it or one split."""
    write: Callable[[Path, RaggedClouds], None] | None = None
    """Write clouds to a new path; None where it is only read."""
    page: str = ""
    """Where the data set is got, which no command can fetch; empty for layouts of anybody's."""


def labels_as(clouds: RaggedClouds, class_names: Sequence[str]) -> Int[np.ndarray, "b"]:
    """Return labels that index ``class_names``, found by name or alias.

    Raises:
        InputError: where there are no labels, a class is none of the names, or a cloud is of
            neither train nor test.
    """
    if clouds.labels is None:
        raise InputError("this layout needs labels, and the clouds have none")
    if not clouds.splits or any(split not in SPLITS for split in clouds.splits):
        raise InputError(
            "this layout needs train or test for every cloud, and some have neither; write one "
            "that needs none, such as --to ply"
        )
    return map_labels(clouds.class_names, clouds.labels, class_names)[0]


def named_folder(path: Path, name: str) -> Path:
    """The folder itself where it is called so, else the one of that name in it."""
    return path if path.name == name else path / name
