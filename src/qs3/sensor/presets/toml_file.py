"""Sensors as TOML: a table for each part, a key for each setting.

Convention:
    A file gives a whole sensor or only what differs from ``base``, a preset's name; without it,
    what a file does not give is as ``qs3`` has it. A relative ``pattern.image`` starts at the
    file's folder. A whole number stands for a number with a point, not the other way round.
"""

import ast
import dataclasses
import difflib
import inspect
import json
import math
import tomllib
import types
from collections.abc import Iterable, Mapping
from pathlib import Path
from textwrap import wrap
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from qs3.errors import InputError
from qs3.sensor.presets.cameras import SENSORS
from qs3.sensor.presets.settings import Sensor

_WIDTH = 96


def load_sensor(path: Path | str) -> Sensor:
    """Read a sensor from a TOML file.

    Args:
        path: The file. Its stem names the sensor where the file has no ``name``.

    Raises:
        InputError: in one line that names the file, and the key by its dotted name, where the file
            cannot be read, a key is unknown or of another type, or the settings make no sensor.
    """
    path = Path(path)
    table = _read(path)
    try:
        base = table.pop("base", "qs3")
        if not isinstance(base, str) or base not in SENSORS:
            raise InputError(f"base: no preset {base!r}; {_offer(str(base), SENSORS)}")
        if "name" not in table:
            table["name"] = path.stem
            table.setdefault("description", f"after {base}")
        sensor = _updated(SENSORS[base], table, "", ("base",))
        return _with_picture(sensor, path) if "image" in table.get("pattern", {}) else sensor
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def sensor_toml(sensor: Sensor) -> str:
    """Write a sensor as TOML, each setting with its meaning; `load_sensor` gives back an equal one.

    Example:
        >>> print(sensor_toml(SENSORS["d435"]).splitlines()[4])
        name = "d435"
    """
    head = "A sensor of qs3. Change what you like, give it a name of its own, and use it with"
    lines = [f"# {head}", "# --sensor THIS_FILE.toml. Unknown keys are errors.", ""]
    lines += _lines(sensor, "")
    return "\n".join(lines) + "\n"


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(
            f"{path}: no such file; name a TOML file or one of {', '.join(SENSORS)} "
            "(qs3 sensors show d435 > my_camera.toml makes one)"
        )
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:  # broken TOML, or not UTF-8
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a TOML file: {reason}") from None


def _updated(settings: Any, table: Mapping[str, Any], prefix: str, others: Iterable[str]) -> Any:
    """The settings with what ``table`` gives; ``prefix`` is its dotted name, a dot at its end."""
    hints = get_type_hints(type(settings))
    values = {}
    for key, value in table.items():
        if key not in hints:
            offer = _offer(key, [*others, *hints], prefix)
            raise InputError(f"no setting {prefix + key!r}; {offer}")
        if dataclasses.is_dataclass(hints[key]):
            if not isinstance(value, dict):
                raise InputError(f"{prefix}{key} is a table, not {value!r}; write [{prefix}{key}]")
            values[key] = _updated(getattr(settings, key), value, f"{prefix}{key}.", ())
        else:
            values[key] = _typed(value, hints[key], prefix + key)
    return dataclasses.replace(settings, **values)


def _typed(value: Any, hint: Any, key: str) -> Any:
    """The value as the type of the field; a bool is no number."""
    origin = get_origin(hint)
    if origin is Literal:
        for choice in get_args(hint):
            if value == choice and type(value) is type(choice):
                return choice
        raise InputError(f"{key} = {_shown(value)}: {_offer(str(value), get_args(hint))}")
    if origin in (Union, types.UnionType):
        (hint,) = (part for part in get_args(hint) if part is not type(None))
        return _typed(value, hint, key)
    if origin is tuple:
        parts = get_args(hint)
        if not isinstance(value, list) or len(value) != len(parts):
            raise InputError(f"{key} = {_shown(value)}: a list of {len(parts)} values is needed")
        pairs = enumerate(zip(value, parts, strict=True))
        return tuple(_typed(one, part, f"{key}[{index}]") for index, (one, part) in pairs)
    if hint is float and type(value) in (int, float):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
    elif hint is not float and type(value) is hint:
        return value
    names = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a text"}
    raise InputError(f"{key} = {_shown(value)}: {names[hint]} is needed")


def _with_picture(sensor: Sensor, path: Path) -> Sensor:
    picture = (path.parent / str(sensor.pattern.image)).resolve()
    if not picture.is_file():
        raise InputError(f"pattern.image: {picture}: no such file")
    pattern = dataclasses.replace(sensor.pattern, image=str(picture))
    return dataclasses.replace(sensor, pattern=pattern)


def _offer(given: str, known: Iterable[Any], prefix: str = "") -> str:
    """The nearest of the valid names, or all of them, each with ``prefix`` before it."""
    names = [str(name) for name in known]
    near = [prefix + name for name in difflib.get_close_matches(given, names)]
    if near:
        return f"did you mean {' or '.join(near)}?"
    return f"choose one of {', '.join(prefix + name for name in names)}"


def _shown(value: Any) -> str:
    """A value in an error: in one line, not endless."""
    text = repr(value)
    return text if len(text) <= 40 else text[:40] + "…"


def _lines(settings: Any, name: str) -> list[str]:
    """One table: its own values, then the tables within."""
    comments = _field_docstrings(type(settings))
    lines, tables = [], []
    for part in dataclasses.fields(settings):
        value, inner = getattr(settings, part.name), f"{name}.{part.name}".lstrip(".")
        comment = [f"# {line}" for line in wrap(comments.get(part.name, ""), _WIDTH)]
        if dataclasses.is_dataclass(value):
            tables += ["", *comment, f"[{inner}]", *_lines(value, inner)]
        elif value is None:
            lines += [*comment, f'# {part.name} = ""']
        else:
            lines += [*comment, f"{part.name} = {_written(value)}"]
    return lines + tables


def _written(value: Any) -> str:
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for the one control character that JSON lets through.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, tuple):
        return f"[{', '.join(_written(one) for one in value)}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value)


def _field_docstrings(cls: type) -> dict[str, str]:
    """The text under each field of a class; empty where its source is not at hand."""
    try:
        body = ast.parse(inspect.getsource(cls)).body[0]
    except (OSError, TypeError, SyntaxError):
        return {}
    found: dict[str, str] = {}
    if not isinstance(body, ast.ClassDef):
        return found
    for field, text in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
            and isinstance(text.value.value, str)
        ):
            found[field.target.id] = " ".join(text.value.value.replace("``", "").split())
    return found
