"""From plain values, as JSON and TOML hold them, to frozen dataclasses and back; strict.

Types are those of the fields' annotations: nothing is converted but a list to a tuple, a whole
number to a float, and text to a path. Unknown keys are refused, in every depth; a key that is left
out takes the field's default. What a dataclass checks itself (`InputError`) is told as it is.
"""

import collections.abc
import dataclasses
import difflib
import functools
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from cattrs import ClassValidationError, Converter, transform_error
from cattrs.errors import ForbiddenExtraKeysError
from cattrs.gen import make_dict_structure_fn

from qs3.errors import InputError

_Kind = TypeVar("_Kind")
_SEQUENCES = (tuple, list, collections.abc.Sequence)
_UNIONS = (typing.Union, types.UnionType)
_MAPPINGS = (dict, collections.abc.Mapping)


def structure(value: Any, kind: type[_Kind], where: str | Path) -> _Kind:
    """Make a dataclass of plain values.

    Args:
        value: What a JSON or TOML file holds.
        kind: The dataclass.
        where: The file, for the message.

    Raises:
        InputError: where a key is unknown or missing, or a value is not of its field's type; file
            and field are named.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Box:
        ...     size: tuple[float, ...]
        ...     name: str = ""
        >>> structure({"size": [1, 2.5]}, Box, "box.json")
        Box(size=(1.0, 2.5), name='')
        >>> structure({"size": [1, "x"]}, Box, "box.json")
        Traceback (most recent call last):
        qs3.errors.InputError: box.json: field 'size[1]': 'x' is not a number
    """
    try:
        return _converter().structure(value, kind)
    except Exception as error:  # cattrs gathers every fault of the tree in groups
        raise InputError(f"{where}: {_reason(error)}") from error


def pick(value: Any, kind: type[_Kind], where: str | Path) -> _Kind:
    """Make a dataclass of those plain values that it has fields for; other keys are ignored."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: not a table of names and values")
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return structure({key: value[key] for key in value if key in names}, kind, where)


def unstructure(value: Any) -> Any:
    """Return a dataclass as plain values that JSON can hold: dicts, lists, text, numbers.

    Example:
        >>> unstructure((Path("a"), 1))
        ['a', 1]
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: unstructure(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): unstructure(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [unstructure(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def first_difference(old: Any, new: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Return name and both values of the first setting that differs, None where none does.

    Names are compared in their order, a dot before those of an inner table; what one of the two
    lacks is None there.

    Example:
        >>> first_difference({"a": 1, "b": {"c": 2}}, {"a": 1, "b": {"c": 3}})
        ('b.c', 2, 3)
    """
    if old == new:
        return None
    tables = [{} if value is None else value for value in (old, new)]
    if all(isinstance(table, Mapping) for table in tables):
        for key in sorted({*tables[0], *tables[1]}):
            inner = f"{name}.{key}" if name else str(key)
            difference = first_difference(tables[0].get(key), tables[1].get(key), inner)
            if difference is not None:
                return difference
        if old is not None and new is not None:
            return None
    return name, old, new


@functools.cache
def _converter() -> Converter:
    converter = Converter(forbid_extra_keys=True)
    converter.register_structure_hook(int, _of(int, "a whole number"))
    converter.register_structure_hook(float, _number)
    converter.register_structure_hook(str, _of(str, "text"))
    converter.register_structure_hook(bool, _of(bool, "true or false"))
    converter.register_structure_hook(Path, _path)
    converter.register_structure_hook_func(lambda kind: get_origin(kind) is typing.Literal, _word)
    for origins, hook in ((_UNIONS, _union), (_SEQUENCES, _sequence), (_MAPPINGS, _mapping)):
        converter.register_structure_hook_func(
            lambda kind, origins=origins: get_origin(kind) in origins,
            functools.partial(hook, converter),
        )
    converter.register_structure_hook_factory(
        dataclasses.is_dataclass, lambda kind: _dataclass(converter, kind)
    )
    return converter


def _dataclass(converter: Converter, kind: Any) -> Any:
    make = make_dict_structure_fn(kind, converter, _cattrs_forbid_extra_keys=True)

    def hook(value: Any, _: Any) -> Any:
        if not isinstance(value, dict):
            raise TypeError(f"{_short(value)} is not a table of settings")
        return make(value, kind)

    return hook


def _number(value: Any, _: Any) -> float:
    if type(value) not in (int, float):
        raise TypeError(f"{_short(value)} is not a number")
    return float(value)


def _of(kind: type, name: str) -> Any:
    def hook(value: Any, _: Any) -> Any:
        if type(value) is not kind:
            raise TypeError(f"{_short(value)} is not {name}")
        return value

    return hook


def _path(value: Any, _: Any) -> Path:
    if not isinstance(value, str | Path):
        raise TypeError(f"{_short(value)} is not a path")
    return Path(value)


def _word(value: Any, kind: Any) -> Any:
    words = get_args(kind)
    # By type too: True equals 1.
    if not any(type(value) is type(word) and value == word for word in words):
        raise TypeError(f"{_short(value)} is none of {', '.join(map(str, words))}")
    return value


def _union(converter: Converter, value: Any, kind: Any) -> Any:
    if value is None and type(None) in get_args(kind):
        return None
    fault: Exception | None = None
    members = [member for member in get_args(kind) if member is not type(None)]
    for member in members:
        try:
            return converter.structure(value, member)
        except Exception as error:
            fault = fault or error
    raise fault or TypeError(f"{_short(value)} is not nothing")


def _sequence(converter: Converter, value: Any, kind: Any) -> Any:
    if not isinstance(value, list | tuple):
        raise TypeError(f"{_short(value)} is not a list")
    inner = get_args(kind)
    if get_origin(kind) is tuple and not (len(inner) == 2 and inner[1] is Ellipsis):
        if len(value) != len(inner):
            raise TypeError(f"a list of {len(value)}, not of {len(inner)}")
        kinds = inner
    else:
        kinds = (inner[0],) * len(value)
    rows = enumerate(zip(value, kinds, strict=True))
    items = [_inside(converter, item, own, f"[{index}]") for index, (item, own) in rows]
    return items if get_origin(kind) is list else tuple(items)


def _mapping(converter: Converter, value: Any, kind: Any) -> Any:
    if not isinstance(value, Mapping):
        raise TypeError(f"{_short(value)} is not a table")
    _, inner = get_args(kind)
    return {
        str(key): _inside(converter, item, inner, f".{_short(key)[1:-1]}")
        for key, item in value.items()
    }


class _InsideError(TypeError):
    """A fault below an element of a list or a table."""

    def __init__(self, place: str, error: Exception) -> None:
        super().__init__(place)
        self.place, self.error = place, error


def _inside(converter: Converter, value: Any, kind: Any, place: str) -> Any:
    if kind is Any:
        return value
    try:
        return converter.structure(value, kind)
    except Exception as error:
        raise _InsideError(place, error) from error


def _reason(error: BaseException, place: str = "") -> str:
    """The first fault, in one line, with the field that has it."""
    if isinstance(error, _InsideError):
        return _reason(error.error, place + error.place)
    if isinstance(error, ForbiddenExtraKeysError):
        name = sorted(map(str, error.extra_fields))[0]
        names = [field.name for field in dataclasses.fields(error.cl)]
        near = [_joined(place, other) for other in difflib.get_close_matches(name, names)]
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        return f"field {_joined(place, name)!r} is unknown{hint}"
    if isinstance(error, ClassValidationError):
        noted, others = error.group_exceptions()
        # An unknown key says more than a missing one: it may be a slip of the pen.
        extra = [inner for inner in others if isinstance(inner, ForbiddenExtraKeysError)]
        if extra:
            return _reason(extra[0], place)
        if noted:
            inner, note = noted[0]
            return _reason(inner, _joined(place, note.name))
        return _reason(others[0], place)
    if isinstance(error, KeyError):
        return f"field {place!r} is missing"
    reason = " ".join((str(error) or transform_error(error)[0]).split())
    return f"field {place!r}: {reason}" if place else reason


def _joined(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _short(value: Any) -> str:
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**30 else "a huge number"
    return text if len(text) <= 60 else f"{text[:57]}..."
