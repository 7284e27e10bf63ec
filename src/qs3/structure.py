"""Convert plain values, as JSON and TOML hold them, to frozen dataclasses and back; strict.

Types are those of the fields' annotations: a list becomes a tuple, a whole number a float, and
text a path; nothing else is converted. Unknown keys are errors at every depth; a missing key takes
the field's default.
"""

import collections.abc
import dataclasses
import difflib
import functools
import inspect
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from qs3.errors import InputError, no_such
from qs3.reading import naming

_Kind = TypeVar("_Kind")
_NAMES = {int: "a whole number", float: "a number", str: "text", bool: "true or false"}
_NAMES |= {Path: "a path"}


def structure(value: Any, kind: type[_Kind] | types.GenericAlias, where: str | Path) -> _Kind:
    """Convert the content of a JSON or TOML file to a dataclass, or to ``dict[str, str]``.

    Raises:
        InputError: if a key is unknown or missing, or a value does not have the type of its field;
            the message names the file ``where`` and the field.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Box:
        ...     size: tuple[float, ...]
        ...     name: str = ""
        >>> structure({"size": [1, 2.5]}, Box, "box.json")
        Box(size=(1.0, 2.5), name='')
    """
    with naming(where):
        return _convert(value, kind, "")


def pick(value: Any, kind: type[_Kind], where: str | Path) -> _Kind:
    """Make a dataclass of those plain values that it has fields for; other keys are ignored."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: not a table of names and values")
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return structure({key: value[key] for key in value if key in names}, kind, where)


def checked_settings(
    kind: type, settings: Mapping[str, Any], what: str, fixed: tuple[str, ...]
) -> dict[str, Any]:
    """Return settings as a class annotates them; lists, which JSON has, become tuples.

    ``what`` is its name, for messages; ``fixed`` are parameters that are not settings.
    """
    table = _table(kind, fixed)
    choice = [field.name for field in dataclasses.fields(table)]
    for key in settings:
        if key not in choice:
            fault = f"unknown setting {key!r} of {what}"
            raise no_such(fault, key, choice) if choice else InputError(f"{fault}; it takes none")
    values = structure(dict(settings), table, f"settings of {what}")
    return {key: getattr(values, key) for key in settings}


@functools.cache
def _table(kind: type, fixed: tuple[str, ...]) -> type:
    hints = typing.get_type_hints(kind.__init__)
    parameters = list(inspect.signature(kind.__init__).parameters.values())[1:]
    names = [p.name for p in parameters if p.kind is not p.VAR_KEYWORD and p.name not in fixed]
    fields = [(name, hints[name], dataclasses.field(default=None)) for name in names]
    return dataclasses.make_dataclass(kind.__name__, fields, frozen=True)


def unstructure(value: Any) -> Any:
    """Return a dataclass as plain values that JSON can hold: dicts, lists, text, numbers."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: unstructure(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): unstructure(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [unstructure(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def first_difference(old: Any, new: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Return name and both values of the first setting that differs; None if all are equal.

    A setting that one of the two lacks is None there.

    Example:
        >>> first_difference({"a": 1, "b": {"c": 2}}, {"a": 1, "b": {"c": 3}})
        ('b.c', 2, 3)
    """
    if old == new:
        return None
    before, now = ({} if value is None else value for value in (old, new))
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in sorted({*before, *now}):
            inner = first_difference(before.get(key), now.get(key), f"{name}.{key}".lstrip("."))
            if inner is not None:
                return inner
        if old is not None and new is not None:
            return None
    return name, old, new


def _fault(place: str, fault: object) -> InputError:
    text = " ".join(str(fault).split())
    return InputError(f"field {place!r}: {text}" if place else text)


def _convert(value: Any, kind: Any, place: str) -> Any:
    """Convert a value to a type; ``place`` is the dotted name of its field."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if dataclasses.is_dataclass(kind):
        return _dataclass(value, kind, place)
    if origin in (typing.Union, types.UnionType):
        return _union(value, inner, place)
    if origin is typing.Literal:
        # By type too: True equals 1.
        if not any(type(value) is type(word) and value == word for word in inner):
            raise _fault(place, f"{_short(value)} must be one of {', '.join(map(str, inner))}")
        return value
    if origin in (tuple, list, collections.abc.Sequence):
        if not isinstance(value, list | tuple):
            raise _fault(place, f"{_short(value)} is not a list")
        if origin is not tuple or inner[-1] is Ellipsis:
            inner = inner[:1] * len(value)
        if len(value) != len(inner):
            raise _fault(place, f"a list of {len(value)}, not of {len(inner)}")
        pairs = enumerate(zip(value, inner, strict=True))
        items = [_convert(item, part, f"{place}[{index}]") for index, (item, part) in pairs]
        return items if origin is list else tuple(items)
    if origin in (dict, collections.abc.Mapping):
        if not isinstance(value, Mapping):
            raise _fault(place, f"{_short(value)} is not a table")
        named = ((str(key), item) for key, item in value.items())
        return {key: _convert(item, inner[1], _joined(place, key)) for key, item in named}
    if kind is Path and isinstance(value, str | Path):
        return Path(value)
    if kind is float and type(value) is int and abs(value) < 10**300:
        return float(value)
    if type(value) is not kind:
        raise _fault(place, f"{_short(value)} is not {_NAMES.get(kind, f'a {kind.__name__}')}")
    return value


@functools.cache
def _fields(kind: Any) -> dict[str, tuple[Any, bool]]:
    """Return type of each field that the constructor takes, and whether it must be given."""
    hints, missing = typing.get_type_hints(kind), dataclasses.MISSING
    return {
        field.name: (hints[field.name], field.default is field.default_factory is missing)
        for field in dataclasses.fields(kind)
        if field.init
    }


def _dataclass(value: Any, kind: Any, place: str) -> Any:
    if not isinstance(value, dict):
        raise _fault(place, f"{_short(value)} is not a table of settings")
    known = _fields(kind)
    # An unknown key first: a missing one may be its correct spelling.
    for name in sorted(str(key) for key in value if key not in known):
        near = [_joined(place, other) for other in difflib.get_close_matches(name, known)]
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        raise InputError(f"field {_joined(place, name)!r} is unknown{hint}")
    values = {}
    for name, (inner, needed) in known.items():
        if name in value:
            values[name] = _convert(value[name], inner, _joined(place, name))
        elif needed:
            raise InputError(f"field {_joined(place, name)!r} is missing")
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:  # the dataclass's own checks, `InputError` among them
        raise _fault(place, error) from error


def _union(value: Any, members: tuple[Any, ...], place: str) -> Any:
    if value is None and types.NoneType in members:
        return None
    faults = []
    for member in members:
        try:
            return _convert(value, member, place)
        except InputError as error:
            faults.append(error)
    raise faults[0]


def _joined(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _short(value: Any) -> str:
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**30 else "a huge number"
    return text if len(text) <= 60 else f"{text[:57]}..."
