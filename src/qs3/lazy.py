"""Packages whose names load when they are first used: what needs few of them starts fast."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def names_of(modules: Mapping[str, str]) -> dict[str, str]:
    """Return the module of each name, from names in one line by module.

    Example:
        >>> names_of({"loading": "EXTENSIONS load_mesh"})
        {'EXTENSIONS': 'loading', 'load_mesh': 'loading'}
    """
    return {name: module for module, names in modules.items() for name in names.split()}


def loader(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package (PEP 562).

    Args:
        package: Its name.
        modules: Names that it hands on, in one line by module.

    Example:
        >>> loader("qs3.meshes", {"classes": "canonical"})("canonical")("desk")
        'table'
    """
    where = names_of(modules)

    def load(name: str) -> Any:
        if name not in where:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{where[name]}"), name)

    return load
