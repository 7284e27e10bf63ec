"""Methods by name; a method's module and PyTorch load on request."""

from typing import TYPE_CHECKING, Any

from qs3.adaptation.names import METHODS
from qs3.lazy import find_class, load_names, name_of
from qs3.structure import checked_settings

if TYPE_CHECKING:
    from qs3.adaptation.method import Method
    from qs3.models import PointClassifier


def list_methods() -> tuple[str, ...]:
    """Return the names that `create_method` knows.

    Example:
        >>> "source-only" in list_methods()
        True
    """
    load_names()
    return tuple(METHODS)


def method_name(method: "str | type[Method]") -> str:
    """Return the name of a method that is given by its class, or by name.

    Example:
        >>> from qs3.adaptation import SourceOnly
        >>> method_name(SourceOnly), method_name("qbst")
        ('source-only', 'qbst')
    """
    return method if isinstance(method, str) else name_of(method, METHODS)


def method_class(name: str) -> "type[Method]":
    """Return the class of a method: one of `list_methods`, or ``module:Class``, imported before.

    Example:
        >>> method_class("source-only").uses_target
        False
    """
    from qs3.adaptation.method import Method

    return find_class("method", name, METHODS, Method)


def create_method(
    name: str,
    model: "PointClassifier",
    *,
    label_smoothing: float = 0.0,
    **settings: Any,
) -> "Method":
    """Make a method around a network; what else it trains is drawn from PyTorch's random state.

    ``settings`` are further fields of the method; those left out keep the paper's values.
    """
    kind = method_class(name)
    checked = checked_settings(kind, settings, f"method {name}", ("model", "label_smoothing"))
    return kind(model, label_smoothing=label_smoothing, **checked)
