"""Furniture of ten classes, one module per class."""

from collections.abc import Callable

from qs3.shapes._dice import Dice
from qs3.shapes._solids import Solid
from qs3.shapes.furniture import (
    bathtub,
    bed,
    bookshelf,
    cabinet,
    chair,
    lamp,
    monitor,
    plant,
    sofa,
    table,
)

_MODULES = (bathtub, bed, bookshelf, cabinet, chair, lamp, monitor, plant, sofa, table)
FURNITURE: dict[str, tuple[Callable[[Dice], list[Solid]], ...]] = {
    module.__name__.rpartition(".")[2]: module.FAMILIES for module in _MODULES
}
"""Families of each class: functions that build its structurally different kinds."""
