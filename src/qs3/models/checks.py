"""Settings of the networks, refused where no network can be made of them."""

import math
from collections.abc import Sequence
from numbers import Integral, Real

from qs3.errors import InputError


def check_whole(name: str, value: object, least: int = 1, most: int | None = None) -> None:
    """Raise InputError unless a setting is a whole number within its range.

    Example:
        >>> check_whole("neighbours", 2.5, 1, 255)
        Traceback (most recent call last):
        qs3.errors.InputError: neighbours must be a whole number, 1 to 255, not 2.5
    """
    if not _is_whole(value, least, most):
        raise InputError(f"{name} must be a whole number, {_span(least, most)}, not {value!r}")


def check_wholes(
    name: str,
    values: object,
    least: int = 1,
    most: int | None = None,
    count: int | None = None,
    few: int = 1,
) -> None:
    """Raise InputError unless a setting is a tuple of whole numbers within their range.

    Args:
        name: The setting.
        values: Its value.
        least: Smallest number allowed.
        most: Largest number allowed, if any.
        count: How many numbers there must be, if that is fixed.
        few: How many there must be at least.
    """
    fits = isinstance(values, tuple | list) and all(_is_whole(v, least, most) for v in values)
    if fits and isinstance(values, Sequence):
        fits = len(values) >= few if count is None else len(values) == count
    if not fits:
        many = f"{few} or more" if count is None else str(count)
        span = _span(least, most)
        raise InputError(f"{name} must be {many} whole numbers, each {span}, not {values!r}")


def check_number(name: str, value: object, least: float = 0.0, most: float | None = None) -> None:
    """Raise InputError unless a setting is a number from ``least`` to ``most``.

    Without ``most`` it must be larger than ``least``, and finite.
    """
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    fits = least < number < math.inf if most is None else least <= number <= most
    if not fits:
        span = f"larger than {least:g}" if most is None else f"{least:g} to {most:g}"
        raise InputError(f"{name} must be a number, {span}, not {value!r}")


def check_choice(name: str, value: object, *choices: str) -> None:
    """Raise InputError unless a setting is one of its choices."""
    if value not in choices:
        raise InputError(f"{name} must be {' or '.join(choices)}, not {value!r}")


def check_flag(name: str, value: object) -> None:
    """Raise InputError unless a setting is true or false."""
    if not isinstance(value, bool):
        raise InputError(f"{name} must be true or false, not {value!r}")


def _is_whole(value: object, least: int, most: int | None) -> bool:
    if not isinstance(value, Integral) or isinstance(value, bool):
        return False
    return least <= int(value) and (most is None or int(value) <= most)


def _span(least: int, most: int | None) -> str:
    return f"at least {least}" if most is None else f"{least} to {most}"
