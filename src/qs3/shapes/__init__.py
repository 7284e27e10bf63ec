"""Procedural furniture of ten classes and machine parts; no file, no download.

Convention:
    Metres, z up. An object stands on z = 0 (one that hangs has its lowest point there) and its
    middle lies over the origin; its front looks toward −y.
"""

import numpy as np
import trimesh

from qs3.errors import InputError, no_such
from qs3.shapes._dice import Dice
from qs3.shapes._solids import assemble
from qs3.shapes.furniture import FURNITURE
from qs3.shapes.parts import PARTS as _PARTS

CLASSES: tuple[str, ...] = tuple(FURNITURE)
"""The ten classes of PointDA-10, in the order of their label."""

PARTS: tuple[str, ...] = tuple(_PARTS)
"""Machine parts, 2 to 12 cm large; a seed changes them by a few percent."""

_FAMILIES = FURNITURE | {name: (build,) for name, build in _PARTS.items()}
_NAMES = (*CLASSES, *PARTS)


def families(class_name: str) -> tuple[str, ...]:
    """Return the names of a class's structurally different families.

    Example:
        >>> "four_legs" in families("chair")
        True
    """
    if class_name not in _FAMILIES:
        raise no_such(f"class {class_name!r} is unknown", class_name, _NAMES)
    return tuple(family.__name__ for family in _FAMILIES[class_name])


def make(class_name: str, seed: int = 0, family: str | None = None) -> trimesh.Trimesh:
    """Make one object; the same class, seed and family give the same vertices.

    Args:
        class_name: One of ``CLASSES`` or ``PARTS``.
        seed: Any whole number ≥ 0; every size and option is drawn from it.
        family: One of ``families(class_name)``; drawn from the seed if None. Naming the
            family that the seed would draw gives the same object.

    Returns:
        A mesh of closed solids that touch or overlap, in metres, z up (see the module's
        convention).

    Example:
        >>> chair = make("chair", seed=3)
        >>> float(chair.bounds[0, 2])
        0.0
    """
    names = families(class_name)
    if family is not None and family not in names:
        raise no_such(f"family {family!r} of {class_name} is unknown", family, names)
    if seed < 0:
        raise InputError(f"seed {seed}: choose a whole number from 0 up")
    rng = np.random.default_rng([seed, *class_name.encode()])
    # The family with the highest number: another family takes its own share of the seeds and leaves
    # the other seeds as they are.
    drawn = max(names, key=lambda name: _number(seed, f"{class_name}/{name}"))
    mirrored = bool(rng.integers(2))
    build = _FAMILIES[class_name][names.index(family or drawn)]
    mesh = assemble(build(Dice(rng)))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    mesh.vertices -= [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]
    if mirrored:
        mesh.vertices, mesh.faces = mesh.vertices * [-1.0, 1.0, 1.0], mesh.faces[:, ::-1]
    mesh.units = "meters"
    return mesh


def _number(seed: int, name: str) -> float:
    return float(np.random.default_rng([seed, *name.encode()]).random())
