"""The merging of labels by the one table of class names and aliases, `qs3.meshes.class_names`."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int

from qs3.errors import InputError
from qs3.meshes.class_names import POINTDA10 as POINTDA10
from qs3.meshes.class_names import canonical as canonical


def _positions(names: Sequence[str], to: Sequence[str]) -> Int[np.ndarray, "k"]:
    """Position in ``to`` of each name, −1 where it is in none: as it is, else by the table.

    A list may hold a class beside its alias (ScanObjectNN: table and desk): the class comes first.
    """
    exact = {name: position for position, name in enumerate(to)}
    merged = {canonical(name): position for position, name in reversed(list(enumerate(to)))}
    known = [(name, canonical(name)) for name in names]
    rows = [exact.get(n, exact.get(folded, merged.get(folded, -1))) for n, folded in known]
    return np.array(rows, dtype=np.int64)


def map_labels(
    class_names: Sequence[str],
    labels: Int[np.ndarray, "b"],
    to: Sequence[str] = POINTDA10,
    unmapped: Literal["error", "drop"] = "error",
) -> tuple[Int[np.ndarray, "m"], Bool[np.ndarray, "b"]]:
    """Put labels onto another list of classes by the table of aliases.

    A name that the other list has as it is keeps it; otherwise aliases are followed on both sides.

    Args:
        class_names: Names that the labels index.
        labels: Labels of the clouds.
        to: Names that the result indexes.
        unmapped: What to do with clouds of a class that is not in ``to``.

    Returns:
        The new labels of the clouds that are kept, and which clouds are kept.

    Raises:
        InputError: where a class of some cloud is not in ``to`` and ``unmapped`` is ``error``.

    Example:
        >>> labels, kept = map_labels(["desk", "dresser"], np.array([1, 0]))
        >>> [POINTDA10[i] for i in labels]
        ['cabinet', 'table']
    """
    mapped = _positions(class_names, to)[labels]
    kept = mapped >= 0
    if unmapped == "error" and not kept.all():
        missing = sorted({class_names[int(i)] for i in np.unique(labels[~kept])})
        raise InputError(
            f"class {', '.join(map(repr, missing))} is none of: {', '.join(to)}; rename it, or "
            "name the classes to use"
        )
    return mapped[kept], kept
