"""Networks by name; a network's module, and PyTorch, load when it is made."""

from typing import TYPE_CHECKING, Any

from qs3.lazy import find_class, load_names
from qs3.structure import checked_settings

if TYPE_CHECKING:
    from qs3.models.classifier import PointClassifier

MODELS: dict[str, str] = {
    "dgcnn": "qs3.models.dgcnn:DGCNN",
    "pointnet": "qs3.models.pointnet:PointNet",
    "pointnet2": "qs3.models.pointnet2:PointNet2",
}
"""Module and class of each network; a package that brings networks adds them."""


def list_models() -> tuple[str, ...]:
    """Return the names that `create_model` knows.

    Example:
        >>> "dgcnn" in list_models()
        True
    """
    load_names()
    return tuple(sorted(MODELS))


def create_model(name: str, num_classes: int, **settings: Any) -> "PointClassifier":
    """Make a network with fresh weights from PyTorch's current random state.

    ``name`` is one of `list_models`, or ``module:Class`` of a module that is imported.
    ``settings`` are arguments of its class.

    Example:
        >>> type(create_model("pointnet", 10, dropout=0.1)).__name__
        'PointNet'
    """
    from qs3.models.classifier import PointClassifier

    make = find_class("model", name, MODELS, PointClassifier)
    return make(num_classes, **checked_settings(make, settings, name, ("num_classes",)))
