"""Settings of networks and methods: unknown ones, wrong types and useless values are refused."""

import dataclasses
import functools
import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard, get_type_hints

import numpy as np

from qs3.errors import InputError, no_such
from qs3.structure import structure

Number = int | float


def read_settings(
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
    hints = get_type_hints(kind.__init__)
    own = list(inspect.signature(kind.__init__).parameters.values())[1:]
    names = [p.name for p in own if p.kind is not p.VAR_KEYWORD and p.name not in fixed]
    fields = [(name, hints[name], dataclasses.field(default=None)) for name in names]
    return dataclasses.make_dataclass(kind.__name__, fields, frozen=True)


def check_range(
    name: str, value: Number | Sequence[Number], least: Number = 1, most: Number = math.inf
) -> None:
    """Raise InputError unless a number, or each of one or more, is in ``least`` to ``most``."""
    numbers = value if isinstance(value, list | tuple) else (value,)
    if not numbers or not all(_is_number(n) and least <= n <= most for n in numbers):
        span = f"at least {least:g}" if most == math.inf else f"{least:g} to {most:g}"
        raise InputError(f"{name} must be {span}, not {value!r}")


def check_positive(name: str, value: Number | Sequence[Number]) -> None:
    """Raise InputError unless a number, or each of one or more, is larger than 0 and finite."""
    numbers = value if isinstance(value, list | tuple) else (value,)
    if not numbers or not all(_is_number(n) and 0 < n < math.inf for n in numbers):
        raise InputError(f"{name} must be larger than 0, not {value!r}")


def _is_number(value: Any) -> TypeGuard[Number]:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)
