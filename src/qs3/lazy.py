"""Packages whose names load when they are first used: a verb that needs few of them starts fast."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def loader(package: str, modules: Mapping[str, str], *others: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package (PEP 562), and let ``dir`` list its names.

    Args:
        package: Its name.
        modules: Names that it re-exports, separated by spaces, by module below it. They also stand
            under ``if TYPE_CHECKING:``, for type checkers and the documentation.
        others: Names that the package loads by itself.

    Example:
        >>> loader("qs3.meshes", {"classes": "canonical POINTDA10"})("canonical")("desk")
        'table'
    """
    places = {
        name: f"{package}.{module}" for module, own in modules.items() for name in own.split()
    }

    def load(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(places[name]), name)

    inside = vars(import_module(package))
    inside["__dir__"] = lambda: sorted({*inside, *places, *others})
    return load
