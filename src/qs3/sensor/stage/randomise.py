"""Domain randomisation: settings of the sensor drawn for each object.

Names are the sensor's own with dots, such as ``light.ambient``. ``material`` draws a named
material; other names draw a number from a range. Names such as ``room.height`` are the place of
camera and object (`qs3.sensor.stage.rooms.Room`).
"""

import dataclasses
import difflib
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, get_type_hints

import numpy as np

from qs3.errors import InputError
from qs3.reading import naming
from qs3.sensor.light.materials import MATERIALS
from qs3.sensor.matching.settings import refuse_unread
from qs3.sensor.presets import Sensor, with_changes
from qs3.sensor.stage.rooms import PLACE, ROOM_RANGES, Room
from qs3.sensor.stage.scene import LAYOUTS

_NAMED = {"material": tuple(MATERIALS), "room.layout": LAYOUTS}
COMMON_MATERIALS = ("diffuse", "principled", "rough-specular", "glossy-plastic", "metal", "dark")
"""Materials in a home that a depth camera sees: no mirrors and no glass."""

_PLACING = ("object_size", "placement", "depth", "rig", "pattern")  # `Sensor` checks them together
_MOST_TOGETHER, _MOST_WHOLE = 12, 1024
_STEPS = 64  # beyond the steps of any whole number that has some
_INSIDE = 0.61803  # no simple fraction

_Settings = TypeVar("_Settings")


def default_ranges(sensor: Sensor) -> dict[str, tuple[Any, ...]]:
    """Return the bundle ``default``: common materials, and light and gain about the sensor's own.

    Ambient light from none to twice the sensor's; the projector from half to twice its power; gain
    from 0.7 to 1.4 of its own.
    """
    light, gain = sensor.light, sensor.exposure.gain
    ranges: dict[str, tuple[Any, ...]] = {
        "material": COMMON_MATERIALS,
        "light.ambient": (0.0, 2 * light.ambient),
        "exposure.gain": (0.7 * gain, 1.4 * gain, "log"),
    }
    if light.projector > 0:
        ranges["light.projector"] = (light.projector / 2, 2 * light.projector, "log")
    return ranges


def resolve_ranges(
    sensor: Sensor, randomise: Mapping[str, Sequence[Any]] | Sequence[str] | None
) -> dict[str, tuple[Any, ...]]:
    """Check the ranges and return them as plain values, in a fixed order.

    Args:
        sensor: The sensor whose settings are named.
        randomise: ``(low, high)`` (uniform) or ``(low, high, "log")`` (uniform in the logarithm)
            by name, and ``material`` a list of names; or such ranges as words:
            ``light.ambient=0:0.1``, ``exposure.gain=0.5:2:log``, ``material=diffuse,metal``;
            ``"default"`` is `default_ranges`, and ``"rooms"`` these (with or without ``"default"``
            beside it) and all of ``ROOM_RANGES``, in part replaced by the words beside it. One
            range of a room brings all of them.

    Example:
        >>> resolve_ranges(Sensor(), {"light.ambient": (0, 0.1)})
        {'light.ambient': (0.0, 0.1)}
        >>> resolve_ranges(Sensor(), ["material=dark,metal", "light.ambient=0:0.1"])
        {'light.ambient': (0.0, 0.1), 'material': ('dark', 'metal')}
    """
    if not isinstance(randomise, Mapping):
        words = [randomise] if isinstance(randomise, str) else list(randomise or ())
        bundles: dict[str, tuple[Any, ...]] = {}
        if words == ["default"] or "rooms" in words:
            bundles = default_ranges(sensor) | (ROOM_RANGES if "rooms" in words else {})
            words = [word for word in words if word not in ("rooms", "default")]
        randomise = bundles | _parsed(words)
    if any(name.startswith("room.") for name in randomise):
        if not sensor.metric:
            raise InputError(
                f"randomise: rooms are in metres, and the sensor {sensor.name} is not; take one "
                "that is, such as d435"
            )
        randomise = ROOM_RANGES | dict(randomise)
    ranges = {name: _range(sensor, name, randomise[name]) for name in sorted(randomise)}
    several = [MATERIALS[name] for name in ranges.get("material", ()) if name in MATERIALS]
    for name in ranges if several else ():
        field = name.removeprefix("material.")
        if field != name and not any(material.reads(field) for material in several):
            raise InputError(
                f"randomise: {name}: none of {', '.join(ranges['material'])} reads it; leave it out"
            )
    rooms = {n.removeprefix("room."): r for n, r in ranges.items() if n.startswith("room.")}
    settled = {f"room.{name}": values for name, values in _settled(Room(), rooms).items()}
    settled |= _settled(sensor, {n: r for n, r in ranges.items() if not n.startswith("room.")})
    return {name: settled[name] for name in ranges}


def _settled(settings: Any, ranges: Mapping[str, tuple[Any, ...]]) -> dict[str, tuple[Any, ...]]:
    """Return ranges of which every draw is one that the settings take.

    The settings check themselves when they are made, all together as a draw sets them: every value
    of a range of whole numbers of which some may not do (a block is odd) beside the low ends of the
    others, then all ends of those that one check may read together.
    """
    low = {name: values[0] for name, values in ranges.items()}
    settled = {name: _admitted(settings, low, name, values) for name, values in ranges.items()}
    low = {name: values[0] for name, values in settled.items()}
    groups: dict[str, list[str]] = {}
    for name, values in settled.items():
        if not isinstance(values[0], str) and values[0] != values[1]:
            head = name.partition(".")[0]
            groups.setdefault("place" if head in _PLACING else head, []).append(name)
    for names in groups.values():
        if len(names) > _MOST_TOGETHER:
            raise InputError(
                f"randomise: {len(names)} ranges that depend on one another ({', '.join(names)}); "
                f"give {_MOST_TOGETHER} of them at most"
            )
        for ends in itertools.product(*(settled[name][:2] for name in names)):
            _try(settings, low, dict(zip(names, ends, strict=True)))
    return settled


def _admitted(
    settings: Any, low: Mapping[str, Any], name: str, values: tuple[Any, ...]
) -> tuple[Any, ...]:
    """Return a range without the whole numbers that the settings refuse."""
    if isinstance(values[0], str):
        for value in values:
            _try(settings, low, {name: value})
        return values
    first, last = values[:2]
    _try(settings, low, {name: first})
    _try(settings, low, {name: last})
    if isinstance(first, float):
        # Of most settings that take both ends, the inside is theirs too; a quantum has gaps.
        _try(settings, low, {name: first + _INSIDE * (last - first)}, f"{name} has gaps: ")
        return values
    span = range(first, last + 1)
    if all(_takes(settings, low, {name: value}) for value in span[:_STEPS]):
        return values
    taken = [value for value in span[:_MOST_WHOLE] if _takes(settings, low, {name: value})]
    step = taken[1] - taken[0] if len(taken) > 1 else 1
    if len(span) > _MOST_WHOLE or taken != [*range(first, last + 1, step)]:
        missing = next(value for value in span if value not in taken)
        _try(settings, low, {name: missing}, f"{name} has gaps: ")
    return first, last, step


def _takes(settings: Any, low: Mapping[str, Any], values: Mapping[str, Any]) -> bool:
    try:
        with_changes(settings, _effective({**low, **values}))
    except InputError:
        return False
    return True


def _try(settings: Any, low: Mapping[str, Any], values: Mapping[str, Any], why: str = "") -> None:
    try:
        with_changes(settings, _effective({**low, **values}))
    except InputError as error:
        drawn = ", ".join(f"{name}={value:.6g}" if isinstance(value, float) else f"{name}={value}"
                          for name, value in {**low, **values}.items())  # fmt: skip
        hint = "give one value, low:low, or narrow the range" if why else "narrow the ranges"
        raise InputError(f"randomise: {why}{drawn} may be drawn, and {error}; {hint}") from None


def draw(
    sensor: Sensor, ranges: Mapping[str, tuple[Any, ...]], rng: np.random.Generator
) -> tuple[Sensor, dict[str, Any]]:
    """Draw a sensor from what `resolve_ranges` returned; a room is `draw_room`'s.

    Each value takes one number of ``rng``; the values by name are returned too.
    """
    return _drawn(sensor, {n: r for n, r in ranges.items() if not n.startswith("room.")}, rng)


def draw_room(
    ranges: Mapping[str, tuple[Any, ...]], rng: np.random.Generator, room: Room | None = None
) -> tuple[Room, dict[str, Any]]:
    """Draw a room from what `resolve_ranges` returned; the same values by name are returned too.

    With a ``room`` the place of another view in it alone is drawn: height, distance and aim.
    """
    room_ranges = {n.removeprefix("room."): r for n, r in ranges.items() if n.startswith("room.")}
    if room is not None:
        room_ranges = {name: values for name, values in room_ranges.items() if name in PLACE}
    room, drawn = _drawn(room or Room(), room_ranges, rng)
    return room, {f"room.{name}": value for name, value in drawn.items()}


def _drawn(
    settings: _Settings, ranges: Mapping[str, tuple[Any, ...]], rng: np.random.Generator
) -> tuple[_Settings, dict[str, Any]]:
    drawn: dict[str, Any] = {}
    for name, values in ranges.items():
        share = float(rng.random())
        if isinstance(values[0], str):
            value = values[min(int(share * len(values)), len(values) - 1)]
        elif isinstance(values[0], int):
            whole = range(values[0], values[1] + 1, *values[2:])
            value = whole[min(int(share * len(whole)), len(whole) - 1)]
        elif len(values) == 3:
            low, high = math.log(values[0]), math.log(values[1])
            value = min(max(math.exp(low + share * (high - low)), values[0]), values[1])
        else:
            value = values[0] + share * (values[1] - values[0])
        drawn[name] = value
    drawn = _effective(drawn)
    # All at once: some depend on one another.
    return with_changes(settings, drawn), drawn


def _effective(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out settings of the material that the one drawn beside them never reads."""
    material = MATERIALS.get(changes.get("material", ""))
    head = "material."
    return {name: value for name, value in changes.items()
            if material is None or not name.startswith(head)
            or material.reads(name.removeprefix(head))}  # fmt: skip


def _parsed(words: Sequence[str]) -> dict[str, tuple[Any, ...]]:
    ranges: dict[str, tuple[Any, ...]] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or name in ranges:
            raise InputError(
                f"randomise: {word!r} is not understood, or named twice; write "
                "light.ambient=0:0.1, material=diffuse,metal, rooms, or default alone"
            )
        if name in _NAMED:
            ranges[name] = tuple(text.split(","))
            continue
        numbers, log = text.split(":"), ()
        if numbers[-1] == "log":
            numbers, log = numbers[:-1], ("log",)
        try:
            ranges[name] = (*(float(number) for number in numbers), *log)
        except ValueError:
            raise InputError(f"randomise: {word!r} has no range such as 0.0:0.1") from None
    return ranges


def numbers_of(settings: Any, prefix: str = "") -> dict[str, type]:
    """The type, int or float, of every number within settings by its dotted name."""
    numbers: dict[str, type] = {}
    for name, kind in get_type_hints(type(settings)).items():
        if dataclasses.is_dataclass(value := getattr(settings, name)):
            numbers |= numbers_of(value, f"{prefix}{name}.")
        elif kind is int or kind is float:
            numbers[prefix + name] = kind
    return numbers


def _range(sensor: Sensor, name: str, values: Sequence[Any]) -> tuple[Any, ...]:
    if name in _NAMED:
        if not values:
            raise InputError(f"randomise: {name}: name some of {', '.join(_NAMED[name])}")
        return (values,) if isinstance(values, str) else tuple(values)
    types = numbers_of(sensor) | numbers_of(Room(), "room.")
    if name.startswith("matching."):
        with naming("randomise"):
            refuse_unread(sensor.matching.method, [name.split(".")[1]])
    if name not in types:
        near = difflib.get_close_matches(name, ["material", *types], n=3, cutoff=0.4)
        hint = f"did you mean {' or '.join(near)}?" if near else "see: qs3 sensors show paper"
        raise InputError(f"randomise: the sensor has no number {name!r}; {hint}")
    plain = [] if isinstance(values, str) else list(values)
    log = plain[2:] == ["log"]
    good = len(plain) == 2 + log and all(
        isinstance(number, int | float) and math.isfinite(number) for number in plain[:2]
    )
    if not good or plain[0] > plain[1] or (log and plain[0] <= 0):
        raise InputError(
            f"randomise: {name}: {values!r} is not a range; give low and high in this order, and "
            "'log' only if both are above 0"
        )
    if types[name] is float:
        return (*map(float, plain[:2]), *plain[2:])
    if log or any(number != int(number) for number in plain):
        raise InputError(f"randomise: {name} takes whole numbers, not {values!r}")
    return (*map(int, plain),)
