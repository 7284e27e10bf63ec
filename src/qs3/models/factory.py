"""Networks by name; a network's module, and PyTorch, load when it is made."""

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from qs3.errors import no_such
from qs3.models.checks import read_settings

if TYPE_CHECKING:
    from qs3.models.classifier import PointClassifier

_MODELS: Mapping[str, str] = {
    "dgcnn": "dgcnn.DGCNN",
    "pointnet": "pointnet.PointNet",
    "pointnet-sa": "pointnet_sa.PointNetSA",
    "pointnet2": "pointnet2.PointNet2",
    "rscnn": "rscnn.RSCNN",
    "simpleview": "simpleview.SimpleView",
}


def list_models() -> tuple[str, ...]:
    """Return the names that `create_model` knows.

    Example:
        >>> "dgcnn" in list_models()
        True
    """
    return tuple(_MODELS)


def create_model(name: str, num_classes: int, **settings: Any) -> "PointClassifier":
    """Make a network of `list_models` with fresh weights from PyTorch's current random state.

    ``settings`` are arguments of its class.

    Example:
        >>> type(create_model("pointnet", 10, dropout=0.1)).__name__
        'PointNet'
    """
    if name not in _MODELS:
        raise no_such(f"unknown model {name!r}", name, _MODELS)
    module, kind = _MODELS[name].split(".")
    make = getattr(import_module(f"qs3.models.{module}"), kind)
    return make(num_classes, **read_settings(make, settings, name, ("num_classes",)))
