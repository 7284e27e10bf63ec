"""Checks of settings' values, with messages that name the setting."""

import functools
import math
import os
import types
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from qs3.errors import InputError, no_such


@dataclass(frozen=True)
class Bounds:
    """Bounds of a number in ``Annotated``; ``above`` and ``below`` refuse the bounds themselves."""

    low: float | int = 0
    high: float | int = math.inf
    above: bool = False
    below: bool = False


@dataclass(frozen=True)
class Option:
    """Form of a setting as an option, in ``Annotated``, if its name is not the option's."""

    name: str | None = None
    """Name of the option; empty makes the fields of nested settings options without a prefix."""
    hidden: bool = False
    """Whether the help leaves the setting out."""
    metavar: str | None = None
    """What the help calls its values, if not by their type."""


INLINE, HIDDEN = Option(name=""), Option(hidden=True)
NotNegative = Annotated[float, Bounds()]
Positive = Annotated[float, Bounds(above=True)]
Share = Annotated[float, Bounds(high=1)]
Natural = Annotated[int, Bounds()]
Seed = Annotated[int, Bounds(high=2**32 - 1)]
"""In the range that scikit-learn takes."""
Count = Annotated[int, Bounds(low=1)]
_TOLERANCE = 0.25
"""Parts differ from their CAD by less; another unit is another matter."""


def check(settings: Any, room: str) -> None:
    """Check the choices, bounds (``Annotated``), ranges and yes or no of a dataclass's fields.

    A range is two numbers, ``tuple[float, float]``, the smaller one first. ``room`` says in the
    message what the settings are of.
    """
    for name, choices in choices_of(type(settings)).items():
        value = getattr(settings, name)
        if value not in choices:
            offer = [str(choice) for choice in choices if choice is not None]
            raise no_such(f"{room}: no {name} {value!r}", str(value), offer)
    hints, bounds = _hints(type(settings)), _bounds(type(settings))
    for name, hint in hints.items():
        value = getattr(settings, name, None)
        if value is None and (hint is None or type(None) in get_args(hint)):
            continue
        if name in bounds:
            check_range(settings, room, name, **vars(bounds[name]))
        elif hint is bool and not isinstance(value, bool | np.bool_):
            raise InputError(f"{room}: {name} {value!r} must be True or False")
        elif tuple[float, float] in (hint, *get_args(hint)):
            _check_pair(f"{room}: {name}", value)


def _check_pair(name: str, value: Any) -> None:
    numbers: Any = value if isinstance(value, list | tuple) else ()
    if [issubclass(type(n), Real) and math.isfinite(n) for n in numbers] != [True, True] or (
        numbers[0] > numbers[1]
    ):
        raise InputError(f"{name} {value!r}: give two numbers, the smaller one first")


def check_range(
    settings: Any,
    room: str,
    *names: str,
    low: float | int = 0,
    high: float | int = math.inf,
    above: bool = False,
    below: bool = False,
) -> None:
    """Check that numbers are finite, whole if their field is, and within bounds (`Bounds`)."""
    bounds = Bounds(low, high, above, below)
    for name in names:
        whole = _hints(type(settings))[name] in (int, int | None)
        _check_number(f"{room}: {name}", getattr(settings, name), bounds, whole)


def check_numbers(
    name: str,
    value: Any,
    low: float | int = 1,
    high: float | int = math.inf,
    *,
    above: bool = False,
) -> None:
    """Check that a number, or each of one or more, is finite and within bounds (`Bounds`)."""
    numbers = value if isinstance(value, list | tuple) else (value,)
    if not numbers:
        raise InputError(f"{name}: give one number or more")
    for number in numbers:
        _check_number(name, number, Bounds(low, high, above), whole=False)


def _check_number(name: str, value: Any, bounds: Bounds, whole: bool) -> None:
    kind = Integral if whole else Real
    if isinstance(value, bool) or not issubclass(type(value), kind):
        raise InputError(f"{name} {value!r} must be a {'whole ' * whole}number")
    within = bounds.low < value if bounds.above else bounds.low <= value
    within = within and (value < bounds.high if bounds.below else value <= bounds.high)
    if not (within and math.isfinite(value)):
        bound = f"{'above' if bounds.above else 'at least'} {bounds.low:.10g}"
        if bounds.high < math.inf:
            bound += f" and {'below' if bounds.below else 'at most'} {bounds.high:.10g}"
        elif value == math.inf:
            bound = "finite"
        raise InputError(f"{name} {value} must be {bound}")


@functools.cache
def choices_of(kind: type) -> dict[str, tuple[Any, ...]]:
    """Return the values that each choice of a dataclass of settings has."""
    choices = {}
    for name, hint in _hints(kind).items():
        union = get_origin(hint) in (Union, types.UnionType)
        optional = union and set(get_args(hint)[1:]) == {type(None)}
        inner = get_args(hint)[0] if optional else hint
        if get_origin(inner) is Literal:
            choices[name] = get_args(inner) + ((None,) if optional else ())
    return choices


_hints = functools.cache(get_type_hints)


@functools.cache
def _bounds(kind: type) -> dict[str, Bounds]:
    hints = get_type_hints(kind, include_extras=True).items()
    extras = ((name, extra) for name, hint in hints for extra in getattr(hint, "__metadata__", ()))
    return {name: extra for name, extra in extras if isinstance(extra, Bounds)}


def check_kind(where: str, value: Any, kind: type) -> None:
    """Raise `InputError` if a value is of no class of `qs3.parts`: arguments may be swapped."""
    if not isinstance(value, kind):
        raise InputError(f"{where}: {str(value)[:80]!r} is no qs3.parts.{kind.__name__}")


def path_of(where: str, value: Any) -> Path:
    """Return a path; a value of another kind raises `InputError`."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{where}: {str(value)[:80]!r} is no path, as text or a Path")
    return Path(value)


def array_of(name: str, value: Any) -> np.ndarray:
    """Return an array, with NaN for what is masked; lists of uneven lengths are refused."""
    try:
        if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
            kind = np.promote_types(value.dtype, np.float16)  # whole numbers have no NaN
            value = np.ma.filled(value.astype(kind), np.nan)
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{name}: is no array of numbers ({error})") from error


def check_tolerance(tolerance: Any) -> None:
    """Raise `InputError` if the tolerance of CAD is no share from 0 to below one quarter."""
    if isinstance(tolerance, bool) or not issubclass(type(tolerance), Real):
        raise InputError(f"tolerance {tolerance!r} must be a number")
    if not 0 <= tolerance < _TOLERANCE:
        raise InputError(
            f"tolerance {tolerance:g}: must be at least 0 and less than {_TOLERANCE:g}; 0.1 allows "
            "parts that are up to 10 % larger or smaller than their CAD"
        )
