"""Clouds as text: rows of numbers, with a line of names, comments or a count before them."""

import csv
import io
import re
from collections.abc import Sequence

import numpy as np

from qs3.clouds.columns import LOOKED_AT, axes_of, columns_of
from qs3.errors import InputError
from qs3.meshes.sizes import METRES, comment_scale, comment_unit
from qs3.reading import plain_numbers, plain_text

_COMMA = r"[-+]?\d+(,\d+([eE][-+]?\d+)?)?"
_DECIMAL_COMMAS = re.compile(rf"(?=.*\d,\d)\s*({_COMMA}([\s;]+|,\s+|$)){{3,}}")
_PAIRS = re.compile(r"(?=.*,0\d)[-+]?\d+(,[-+]?\d+){5,}")
"""Whole numbers and fractions in turns, one of which begins with 0, as no whole number does."""
_FRACTIONS = re.compile(r"[-+]?\d+,(\d+)(?:,[-+]?\d+,(\d+)){2}(?:,[^.]*)?")
_THOUSANDS = re.compile(r"([-+]?\d{1,3}( \d{3})+([.,]\d+)?(\t|$)){3,}")
_QUOTES = "\"' "
_UNIT_APART = re.compile(r"(?i)(?<![^\W_])([xyz])\s+(?=[\[(]\w+[\])](\s|$))")
_EMPTY = re.compile(
    rb"(?<=[,;])[ \t]*(NA|N/A|null|NULL|None)?[ \t]*(?=[,;\n]|\Z)"
    rb"|^[ \t]*(NA|N/A|null|NULL|None)?[ \t]*(?=[,;])",
    re.MULTILINE,
)
"""A cell without a number, as pandas writes NaN."""


def read_text(content: bytes, where: str = "") -> np.ndarray:
    """Read rows of numbers separated by spaces, commas or semicolons; ``#`` begins a comment.

    ``where`` begins its warnings.
    """
    content = plain_numbers(plain_text(content).rstrip(b"\0\x1a"))
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    names: list[str] = []
    comment, count, first, start = False, None, "", 0
    for line in re.finditer(rb"[^\n]*\n?", content):
        first = line[0].decode("utf-8", "replace").strip()
        if len(_UNIT_APART.findall(first)) == 3:
            first = _UNIT_APART.sub(r"\1", first)
        bare = first.lstrip("#/% ").rpartition(": ")[2]
        words = re.split(r"[,;\t]" if re.search(r"[,;\t]", bare) else r"\s+", bare)
        held = first.rstrip(",; \t")
        cells = re.split(r"[,;\t]" if re.search(r"[,;\t]", held) else r"\s+", held)
        if re.fullmatch(r'(?i)"?sep=.?"?', first) or not first.strip(',; \t"'):
            pass  # for Excel; an empty row
        elif first[:1] in {"#", "/", "%"}:
            words = words if axes_of(words) else re.split(r"[,;\s]+", bare)
            if axes_of(words):
                names, comment = words, True
        elif first.isdigit() and count is None:
            count = int(first)
        elif not comment and (merged := _with_units(names, cells)):
            names = merged
        elif first and not any(map(_is_number, [*cells, held.split()[0]])):
            if not axes_of(cells):
                raise InputError(
                    f"could not convert string {cells[0][:40]!r}: its first line names no columns "
                    "x, y and z"
                )
            names, comment = cells, False
        elif first:
            break
        start = line.end()
    else:
        raise InputError("has no row of numbers")
    lines = content[start : start + 100 * LOOKED_AT].decode("utf-8", "replace").split("\n")
    for line in map(str.strip, lines[:LOOKED_AT]):
        if _DECIMAL_COMMAS.fullmatch(line) or _PAIRS.fullmatch(line):
            raise InputError(f"has decimal commas: {line[:40]!r}; write points")
        if _THOUSANDS.fullmatch(line):
            raise InputError(f"has numbers with spaces in them: {line[:40]!r}; leave them out")
    apart = next((sign for sign in ";," if sign in first), None)
    body = content[start:]
    if apart and first.endswith(apart):
        first = first.rstrip(",; \t")
        body = re.sub(rb"[,;][ \t]*$", b"", body, flags=re.MULTILINE)
        apart = next((sign for sign in ";," if sign in first), None)
    if apart == ";" and "," in first:
        raise InputError(f"separates numbers by ; and by ,: {first[:40]!r}; use one of them")
    width = len(next(csv.reader([first], delimiter=apart)) if apart else first.split())
    axes = axes_of(names)
    scale = axes and axes.scale  # also of a comment that names fewer columns
    if axes and comment and len(names) != width:  # it may be prose
        if width > 3 and axes.columns != (0, 1, 2):
            raise InputError(f"its comment names columns, but not all {width}; name each")
        axes = None
    if axes and len(names) < width:
        raise InputError(
            f"its first line names {len(names)} columns, and its rows have {width}; name the first "
            "column too"
        )
    if axes and max(axes.columns) >= width:
        raise InputError(f"its rows have {width} columns, fewer than its first line names")
    columns = axes and axes.columns
    if not axes and apart == "," and _are_fractions(lines):
        raise InputError(f"has decimal commas: {first[:40]!r}; write points, or name its columns")
    if apart and not _EMPTY.search(first.encode()):
        body = _EMPTY.sub(b"nan", body)
    if count is not None and (more := re.search(rb"^[ \t]*\d+[ \t]*$", body, re.MULTILINE)):
        line = content[:start].count(b"\n") + body[: more.start()].count(b"\n") + 1
        raise InputError(f"holds several scans: line {line} is a count again; split it")
    rows = np.loadtxt(io.BytesIO(body), delimiter=apart, usecols=columns, ndmin=2, quotechar='"')
    if count not in (None, len(rows)):
        raise InputError(f"declares {count} points, but has {len(rows)}; the file is damaged")
    # The names may end in one unit: x y z [mm].
    unit = comment_unit(content[:start] + f"\n# {' '.join(names)}\n".encode(), where)
    if scale and unit and METRES[unit] != scale:
        raise InputError(f"its comment names the unit {unit}, and its columns another; correct one")
    scale = scale or comment_scale(unit, where)
    if axes:
        return rows * scale
    if re.fullmatch(r"[\s,;]*0[\s,;]+1[\s,;]+2([\s,;]+\d+)*", first) and (rows % 1).any():
        raise InputError(f"its first line {first[:40]!r} counts the columns; name them x, y and z")
    return columns_of(rows) * scale


def _with_units(names: Sequence[str], cells: Sequence[str]) -> list[str]:
    """Return names of columns with the units in the row below them; empty if that holds none."""
    axes = axes_of(names)
    units = [cell.strip("[(\"' )]") for cell in cells]
    if not axes or len(units) != len(names):
        return []
    if not all(units[at].isalpha() and not _is_number(units[at]) for at in axes.columns):  # NaN
        return []
    pairs = zip(names, units, strict=True)
    return [f"{name.strip(_QUOTES)} [{unit}]" if unit else name for name, unit in pairs]


def _are_fractions(lines: Sequence[str]) -> bool:
    """Whether whole numbers alternate with fractions of as many digits in every line."""
    found = [_FRACTIONS.fullmatch(line.strip()) for line in lines[:LOOKED_AT][:-1]]
    digits = {len(group) for match in found if match for group in match.groups()}
    return len(found) > 2 and all(found) and len(digits) == 1


def _is_number(word: str) -> bool:
    try:
        float(word.strip(_QUOTES))
    except ValueError:
        return False
    return True
