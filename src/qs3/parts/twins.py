"""Two classes that no scan can tell apart, in whatever pose their files were drawn."""

import math
from collections.abc import Sequence

import numpy as np

from qs3.errors import InputError, say_once
from qs3.parts.library import Library, note_copies
from qs3.parts.locating import compare
from qs3.parts.places import Place
from qs3.parts.scan import prepare
from qs3.parts.views import Part
from qs3.parts.visible import VIEWS, directions, visible

_AREA, _SPREAD, _STEP = 0.02, 0.04, 25
"""Shares by which the areas of two files that are compared may differ, and the deviations of their
points along their axes, in the largest; every such view is seen."""
_MISFIT = 1.0
"""Misfit of no view of the one with the other from which on they differ. Of eight built-in parts,
turned or 1 % larger, it is at most 0.93; of mirror images with another shape at least 6."""


def note_twins(parts: Sequence[Part]) -> None:
    """Warn of two classes of one shape, or nearly one: answers may name either."""
    note_copies(parts)
    known = list[Part]()
    for part in parts:
        others = (other for other in known if other.class_name != part.class_name)
        if twin := next((other for other in others if _are_twins(other, part)), None):
            say_once(
                f"{twin.cad} and {part.cad} have nearly the same shape, and scans hardly tell "
                f"{twin.class_name} from {part.class_name}: remove one"
            )
        known.append(part)


def _are_twins(one: Part, other: Part) -> bool:
    if one.shape and one.shape == other.shape:
        return False  # they are copies
    if not math.isclose(one.spacing**2, other.spacing**2, rel_tol=_AREA):
        return False
    deviations = [np.sqrt(np.linalg.eigvalsh(np.cov(part.points.T))) for part in (one, other)]
    if abs(deviations[0] - deviations[1]).max() > _SPREAD * deviations[0].max():
        return False
    try:
        for way in directions(VIEWS)[::_STEP]:
            eye = one.middle + one.away * way
            x, y, z = eye.tolist()
            scan = prepare(one.points[visible(one.points, one.spacing, eye, one.middle)], eye)
            found = compare(Library((other,)), scan, Place(camera=(x, y, z)))
            if not found or found[0].misfit > _MISFIT:
                return False
    except InputError:  # a wire is a line to a camera, and a ship too far away
        return False
    return True
