"""Packages whose names load when they are first used: what needs few of them starts fast."""

import ast
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any


def handed_on(file: str) -> dict[str, str]:
    """Return the module of each name that a package's file imports under ``if TYPE_CHECKING:``.

    So what type checkers and readers see is what loads, and each name is told once.

    Example:
        >>> import qs3.meshes
        >>> handed_on(qs3.meshes.__file__)["load_mesh"]
        'qs3.meshes.loading'
    """
    parts = [part for part in ast.parse(Path(file).read_bytes()).body if isinstance(part, ast.If)]
    imports = [line for part in parts for line in part.body if isinstance(line, ast.ImportFrom)]
    return {alias.name: str(line.module) for line in imports for alias in line.names}


def loader(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package (PEP 562).

    Args:
        package: Its name.
        modules: Module of each name that it hands on, see `handed_on`.

    Example:
        >>> loader("qs3.meshes", {"canonical": "qs3.meshes.classes"})("canonical")("desk")
        'table'
    """

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(modules[name]), name)

    return load
