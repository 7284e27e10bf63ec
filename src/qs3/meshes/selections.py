"""Which classes of a collection to take, and under which names."""

from collections.abc import Sequence

from qs3.errors import InputError
from qs3.meshes.class_names import (
    POINTDA10,
    POINTDA10_OF_MODELNET,
    POINTDA10_OF_SHAPENET,
    canonical,
)
from qs3.meshes.trees import Leaf

POINTDA10_CHOICE = "pointda10"
"""The choice that takes PointDA-10's ten classes and gives them its names."""

_MOST_NAMES = 60


def chosen_names(classes: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """Bring a choice of classes into one form: a tuple of names, or None for all.

    Raises:
        InputError: where no class is named, or ``pointda10`` stands beside others.
    """
    if classes is None:
        return None
    names = (classes,) if isinstance(classes, str) else tuple(classes)
    if not names:
        raise InputError("classes: name at least one")
    if POINTDA10_CHOICE in names and len(names) > 1:
        raise InputError(f"classes {', '.join(names)}: {POINTDA10_CHOICE} stands for ten; alone")
    return names


def rename(leaves: Sequence[Leaf], classes: Sequence[str], source: str) -> list[str | None]:
    """New class name of each mesh; None where it is not chosen.

    ``("pointda10",)`` takes the ten classes that ModelNet40, ShapeNet and ScanNet share. Of
    ModelNet these are exactly ten folders (night_stand becomes cabinet; dresser, wardrobe, desk,
    bench, stool and tv_stand stay out), of ShapeNet ten synsets (display becomes monitor, pot
    becomes plant), of anything else whatever ``canonical`` maps onto them. Any of the ten may be
    missing. Other choices are names as they stand in the collection.

    Args:
        leaves: The meshes.
        classes: The choice, by ``chosen_names``.
        source: Name of the collection, for messages.

    Raises:
        InputError: where a class is not there, or none of the ten.
    """
    have = {(leaf.layout, leaf.class_name) for leaf in leaves}
    if tuple(classes) == (POINTDA10_CHOICE,):
        names = {key: _of_pointda10(*key) for key in have}
        if not any(names.values()):
            raise InputError(f"{source}: none of PointDA-10's ten classes; {_listed(have)}")
    else:
        for name in classes:
            if name not in {own for _, own in have}:
                raise InputError(f"{source}: no class {name!r}; {_listed(have)}")
        names = {key: key[1] if key[1] in classes else None for key in have}
    return [names[leaf.layout, leaf.class_name] for leaf in leaves]


def _of_pointda10(layout: str, name: str) -> str | None:
    if layout == "modelnet":
        return POINTDA10_OF_MODELNET.get(name)
    if layout == "shapenet":
        return POINTDA10_OF_SHAPENET.get(name)
    return canonical(name) if canonical(name) in POINTDA10 else None


def _listed(have: set[tuple[str, str]]) -> str:
    names = sorted({name for _, name in have if name})
    if not names:
        return "its meshes lie flat, without classes"
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"it has {', '.join(names[:_MOST_NAMES])}{more}"
