"""TOML files of settings: read, laid over defaults, written with what each setting means."""

import ast
import dataclasses
import inspect
import itertools
import json
import math
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from textwrap import wrap
from typing import Any

from qs3.errors import InputError
from qs3.reading import reading

_WIDTH = 96


def read_toml(path: Path, hint: str = "name a TOML file") -> dict[str, Any]:
    """Read a TOML file whose numbers are finite; ``hint`` ends messages."""
    try:
        with reading(path, "TOML"):
            return tomllib.loads(path.read_text(encoding="utf-8-sig"), parse_float=_finite)
    except InputError as error:
        raise InputError(f"{error}; {hint}") from None


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} is not a finite number")
    return number


def merged(whole: Mapping[str, Any], table: Mapping[str, Any]) -> dict[str, Any]:
    """Lay a file over defaults, table by table."""
    both = {**whole, **table}
    for key in whole.keys() & table.keys():
        if isinstance(whole[key], dict) and isinstance(table[key], dict):
            both[key] = merged(whole[key], table[key])
    return both


def toml_lines(settings: Any, name: str = "", without: Collection[str] = ()) -> list[str]:
    """Return a dataclass as TOML, each setting below its docstring: own values, then inner tables.

    TOML has no word for None: a comment stands in its place. Dotted names of ``without`` are left
    out.
    """
    comments = _field_docstrings(type(settings))
    lines, tables = [], []
    for part in dataclasses.fields(settings):
        value, inner = getattr(settings, part.name), f"{name}.{part.name}".lstrip(".")
        if inner in without:
            continue
        comment = [f"# {line}" for line in wrap(comments.get(part.name, ""), _WIDTH)]
        if dataclasses.is_dataclass(value):
            within = toml_lines(value, inner, without)
            tables += ["", *comment, f"[{inner}]", *within]
        elif value is None:
            lines += [*comment, f'# {part.name} = ""']
        else:
            lines += [*comment, f"{part.name} = {_written(value)}"]
    return lines + tables


def _written(value: Any) -> str:
    if isinstance(value, str | Path):
        # JSON's escapes are TOML's, but for the one control character that JSON lets through.
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, Mapping):
        pairs = (f"{_written(str(key))} = {_written(item)}" for key, item in value.items())
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_written(item) for item in value)}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value)


def _field_docstrings(cls: type) -> dict[str, str]:
    """Return the text under each field of a class and its bases; none without its source."""
    docstrings: dict[str, str] = {}
    for kind in reversed(cls.__mro__):
        try:
            body = ast.parse(inspect.getsource(kind)).body[0]
        except (OSError, TypeError, SyntaxError):
            continue
        statements = body.body if isinstance(body, ast.ClassDef) else []
        for field, text in itertools.pairwise(statements):
            match field, text:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(ast.Constant(str(words))):
                    docstrings[name] = " ".join(words.replace("``", "").split())
    return docstrings
