"""Networks by name."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

from qs3.errors import InputError
from qs3.models.checks import check_whole
from qs3.models.classifier import PointClassifier
from qs3.models.dgcnn import DGCNN
from qs3.models.pointdan_net import PointNetSA
from qs3.models.pointmlp import PointMLPElite
from qs3.models.pointnet import PointNet
from qs3.models.pointnet2 import PointNet2
from qs3.models.rscnn import RSCNN
from qs3.models.simpleview import SimpleView

_MODELS: dict[str, Callable[..., PointClassifier]] = {
    "dgcnn": DGCNN,
    "pointmlp-elite": PointMLPElite,
    "pointnet": PointNet,
    "pointnet-sa": PointNetSA,
    "pointnet2": PointNet2,
    "pointnet2-msg": partial(PointNet2, grouping="msg"),
    "rscnn": RSCNN,
    "simpleview": SimpleView,
}


def list_models() -> tuple[str, ...]:
    """Return the names that `create_model` knows.

    Example:
        >>> "dgcnn" in list_models()
        True
    """
    return tuple(_MODELS)


def create_model(name: str, num_classes: int, **settings: Any) -> PointClassifier:
    """Make a network with fresh weights from PyTorch's current random state.

    Args:
        name: One of `list_models`.
        num_classes: Number of classes, at least 1.
        settings: Arguments of that network; those left out keep their defaults.

    Raises:
        InputError: where the name or a setting is unknown, or a value is unusable.

    Example:
        >>> type(create_model("pointnet", 10, dropout=0.1)).__name__
        'PointNet'
    """
    if name not in _MODELS:
        raise InputError(f"unknown model {name!r}; choose one of {', '.join(_MODELS)}")
    check_whole("num_classes", num_classes)
    make = _MODELS[name]
    fixed = {"num_classes", *(make.keywords if isinstance(make, partial) else ())}
    known = [
        parameter for parameter in inspect.signature(make).parameters if parameter not in fixed
    ]
    for key in settings:
        if key not in known:
            raise InputError(f"unknown setting {key!r} of {name}; choose from {', '.join(known)}")
    values = {key: _tuples(value) for key, value in settings.items()}
    try:
        return make(num_classes, **values)
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(f"settings {settings} do not make a {name}: {error}") from error


def _tuples(value: Any) -> Any:
    """Return tuples for lists, at any depth: JSON has lists only, the networks want tuples."""
    return tuple(_tuples(part) for part in value) if isinstance(value, list | tuple) else value
