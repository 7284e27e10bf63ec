"""Classes and functions by name, which load on request: a verb that needs few starts fast."""

import functools
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

PACKAGES: list[str] = []
"""Modules that add networks, methods and layouts by name, which load if a name is not known."""


def load_names(name: str = "", *tables: Mapping[str, Any]) -> None:
    """Import `PACKAGES`, which add their names to tables, unless a table has the name already.

    A name as ``module:Class`` is in no table. Without a name all of them are imported.
    """
    if ":" not in name and not any(name in table for table in tables):
        for package in PACKAGES:
            import_module(package)


def find_class(what: str, name: str, known: Mapping[str, str], base: type) -> Any:
    """Return a class by its name in ``known``, or as ``module:Class`` of an imported module.

    A file may hold such a name, and no file may run code: `import_from` imports the module if the
    user names it.

    Example:
        >>> find_class("error", "missing", {"missing": "qs3.errors:InputError"}, Exception).__name__
        'InputError'
    """
    from qs3.errors import InputError, no_such

    load_names(name, known)
    module, colon, kind = known.get(name, name).partition(":")
    if not colon:
        more = f"; a package that brings a {what} of this name must be imported first"
        raise no_such(f"unknown {what} {name!r}", name, known, more)
    if name not in known and module not in sys.modules:
        raise InputError(
            f"{what} {name} is no part of qs3; if you trust the module {module}, import it first "
            f"(command line: QS3_IMPORT={module})"
        )
    found = getattr(import_module(module), kind, None)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise InputError(f"{what} {name}: {kind} in {module} is no {base.__name__}")
    return found


def name_of(kind: type, known: Mapping[str, str]) -> str:
    """Return the name by which `find_class` finds a class: one in ``known``, or ``module:Class``.

    Example:
        >>> from qs3.errors import InputError
        >>> name_of(InputError, {"input": "qs3.errors:InputError"}), name_of(InputError, {})
        ('input', 'qs3.errors:InputError')
    """
    load_names()
    place = f"{kind.__module__}:{kind.__qualname__}"
    return next((name for name, where in known.items() if where == place), place)


def import_from(*names: str) -> None:
    """Import modules that the user named, also as ``module:Class`` and from this folder."""
    from qs3.errors import InputError

    for name in names:
        module = name.partition(":")[0]
        if module not in sys.modules and str(Path.cwd()) not in sys.path:
            sys.path.append(str(Path.cwd()))
        try:
            import_module(module)
        except ModuleNotFoundError as error:
            hint = "start qs3 in the folder of the module, or set PYTHONPATH"
            raise InputError(f"{name}: {error}; {hint}") from error


def loader(package: str, *others: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package (PEP 562), and let ``dir`` list its names.

    Its names are those that it imports under ``if TYPE_CHECKING:``; they load on request.

    Args:
        package: Its name.
        others: Names that the package loads by itself.
    """
    inside = vars(import_module(package))

    @functools.cache
    def places() -> dict[str, str]:
        import ast  # only if a name is asked for

        body = ast.parse(inside["__loader__"].get_source(package)).body
        (block,) = (node for node in body if isinstance(node, ast.If))
        lines = (line for line in block.body if isinstance(line, ast.ImportFrom))
        return {alias.name: str(line.module) for line in lines for alias in line.names}

    def load(name: str) -> Any:
        if name not in places():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(places()[name]), name)

    inside["__dir__"] = lambda: sorted({*inside, *places(), *others})
    return load
