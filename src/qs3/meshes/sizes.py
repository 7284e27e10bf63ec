"""Real sizes of meshes: by the unit of the file, or by the usual sizes of the class."""

import functools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from qs3.errors import InputError, say_once
from qs3.meshes.cad_text import UNITS, declared_unit
from qs3.meshes.classes import canonical

if TYPE_CHECKING:
    import trimesh

Unit = Literal["m", "cm", "mm", "in"]
"""Units of a mesh that a user can name."""
METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}

_COMMENT = re.compile(
    r"^[ \t]*(?:[#%]|//|comment\b|obj_info\b)[#%/* \t\"'(\[]*([^\n]*)", re.MULTILINE | re.IGNORECASE
)
_NAMES = r"(?:points?|coord(?:inate)?s?|vert(?:ex|ices)|lengths?|dimensions?|values|xyz)"
_WHOLE = r"(?:the|all|file|model|mesh|document|measure(?:ment)?)"
_IS = r"[\s:=\"'(\[]*(?:(?:used|is|are|in)[\s:=]+){0,3}[\"'(\[]*"
_UNIT = (
    r"(in(?=[\"')\].;, \t\r]*$)|inch(?:es)?|[cm]?m|(?:milli|centi)?met(?:er|re)s?"
    r"|[\xb5\u03bcun]m|micro(?:n|met(?:er|re))s?|km|kilomet(?:er|re)s?|ft|foot|feet)(?![\w/^\xb2])"
)
_ONE = rf"(?:1|one)\s+unit\s*(?:=|is|:)\s*(?:(?:1|one)\s*)?{_UNIT}"
_BEGINS = re.compile(
    rf"(?:{_WHOLE}\s+)*(?:(?:(?:{_NAMES}[\s_-]+)?units?\b|{_NAMES}\s+(?:are\s+)?in\b"
    rf"|(?:x[ \t,;]*y[ \t,;]*z|points|coordinates)[ \t,;]*(?:(?:are\s+)?in\b|(?=[\[(])))(?!\w)"
    rf"{_IS}{_UNIT})|{_ONE}|(?:this\s+)?(?:{_WHOLE}\s+)+uses\s+{_UNIT}\s+as\s+(?:the\s+)?units?\b",
    re.IGNORECASE,
)
_WITHIN = re.compile(
    r"\b(?:export(?:ed)?|saved|written|created|generated|made)\s+by\b.*"
    rf"(?:[,;|(\[{{.:-]\s*|\b(?:with|using)\s+)[\"']?(?:{_WHOLE}\s+)*units?\b{_IS}{_UNIT}"
    r"|\b(?:exported|saved|written|points|coord(?:inate)?s|vertices)"
    rf"\s+(?:are\s+|is\s+)?in\s+{_UNIT}"
    rf"|(?<![\d.\w]){_ONE}",
    re.IGNORECASE,
)
_UNSURE = re.compile(
    rf"units?\b[\s:=\"'(\[]*([\d.e= -]*{_UNIT})|(?<![\w.])(?<!\d ){_UNIT}\s+(?:as\s+)?units?\b",
    re.IGNORECASE,
)
_STATED = re.compile(rf"(?<![\w.])(?<!\d ){_UNIT}", re.IGNORECASE)  # not of a quantity, as 5 mm
_NO_POINTS = re.compile(
    r"(?i)\b(voxel|normal|time|intensity|resolution|tolerance|accuracy|precision|distance|size"
    r"|radius|spacing|noise|error|deviation|colou?r|sensor|camera|baseline|focal|curvature|area"
    r"|volume|grid|box|bound|extent|origin|cent(?:er|re|roid)|scalar|depth|height|thickness|offset"
    r"|marker|board|pixel|translation|displacement|convert|registered|aligned|unknown"
    r"|(was|were|not|no)\b)"
)
"""Words of a comment whose unit may be that of something else, or of other points."""
_LONGEST = 1000  # characters of a comment that are looked at
_SPELLED = {"inch": "in", "millimet": "mm", "centimet": "cm", "met": "m"}

CLASS_SIZES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "bathtub": ((1.2, 1.8), (0.35, 0.65)),
    "bed": ((1.6, 2.6), (0.4, 1.7)),
    "bookshelf": ((0.7, 3.0), (0.4, 2.4)),
    "cabinet": ((0.45, 2.2), (0.4, 2.2)),
    "chair": ((0.5, 1.3), (0.4, 1.2)),
    "lamp": ((0.3, 1.8), (0.25, 1.8)),
    "monitor": ((0.35, 1.4), (0.25, 0.9)),
    "plant": ((0.25, 1.8), (0.2, 1.8)),
    "sofa": ((1.2, 2.6), (0.6, 1.0)),
    "table": ((0.5, 2.3), (0.4, 1.05)),
}
"""Longest side and height of each class in metres, from and to.

They hold the mean boxes of SUN RGB-D if they exist (VoteNet, Qi et al., ICCV 2019,
model_util_sunrgbd.py: bathtub 1.40 × 0.47, bed 2.11 × 0.93, bookshelf 1.69, chair 0.83, dresser
1.17, night stand 0.68, desk 1.35 × 0.74, sofa 1.87 × 0.85, table 1.28 × 0.72, longest × height),
and go up to the 95 % quantile of what single views of NYU Depth v2 show of 820 objects (1.46, 2.52,
2.94, 2.11, 1.28, 1.20, 1.27, 1.16, 2.46, 2.16 in this order) at least. Our choice: the lower ends,
as those of NYU are of parts; floor lamps and plants of 1.8 m, baths of 1.8 m.
"""

SUPPORTS: dict[str, tuple[float, tuple[tuple[float, float, float], ...]]] = {
    "bookshelf": (1.2, ((0.5, 0.7, 1.8),)),
    "cabinet": (1.2, ((0.5, 1.3, 1.6),)),
    "lamp": (0.8, ((0.9, 0.4, 0.8),)),
    "monitor": (1.4, ((0.75, 0.5, 0.9), (0.2, 0.9, 1.5))),
    "plant": (0.8, ((0.7, 0.4, 1.1),)),
}
"""Supports of the objects of a class in rooms: up to which longest side, and shares with the height
of the support above the floor, from and to, in metres. All others stand on the floor.

Our choice, from how homes and offices are furnished, not from labelled scans: tables, desks and
sideboards are 0.4 to 0.9 m high, sills 0.8 to 1.1 m. Small lamps stand on tables and bedsides;
screens on desks and sideboards, or hang at the height of the eyes; pots stand on tables and sills,
small shelves on desks and walls; wall units hang half a metre above a worktop of 0.9 m.
"""

_METRES_TO = 5.0
"""A longest side up to this is taken for metres if no unit is known: no furniture is longer, and as
millimetres no part that a depth camera shows is smaller."""
_LEAST, _MOST = 1e-3, 10.0


def comment_unit(head: bytes, where: str = "") -> Unit | None:
    """Return the unit that comments of a text or a header name; None if they name none.

    Comments begin with ``#``, ``%``, ``//``, and with ``comment`` or ``obj_info`` in PLY. A unit
    after other words counts if these tell who wrote the file, and none of them may have it, as a
    voxel, a normal or a time has. A comment that names a second unit is not believed. A unit that
    is not believed is reported; ``where`` begins the message.

    Example:
        >>> comment_unit(b"comment units: millimeters"), comment_unit(b"# unit vectors")
        ('mm', None)
    """
    named = set()
    for text in _COMMENT.findall(head.decode("utf-8", "replace")):
        text = text[:_LONGEST]
        found = _BEGINS.match(text) or (not _NO_POINTS.search(text) and _WITHIN.search(text))
        if found:
            unit = short_unit(next(filter(None, found.groups())).lower())
            stated = {short_unit(word.lower()) for word in _STATED.findall(text)}
            if unit not in METRES or stated & METRES.keys() <= {unit}:
                named.add(unit)
        elif unsure := _UNSURE.search(text):
            word = next(filter(None, unsure.groups())).strip().lower()
            if short_unit(word) not in ("m", "1 m"):
                say_once(
                    f"{where}the comment {text[:60].strip()!r} does not count as the unit of "
                    "points; if it is theirs, write units: mm at its beginning",
                    "unit of a comment",
                )
    if other := sorted(named - METRES.keys()) or (sorted(named) if len(named) > 1 else []):
        raise InputError(
            f"its comments name the unit {' and '.join(other)}; write it in m, cm, mm or in"
        )
    return next((unit for unit in get_args(Unit) if unit in named), None)


def short_unit(word: str) -> str:
    """Return the short name of a unit, mm of millimetres; another word as it is."""
    return next((unit for start, unit in _SPELLED.items() if word.startswith(start)), word)


def comment_scale(unit: str | None, where: str) -> float:
    """Return the metres of one unit of a cloud that `comment_unit` found, and say it; 1 if none.

    ``where`` names the file at the start of what is said.
    """
    if unit in (None, "m"):
        return 1.0
    text = f"{where}points are converted from {unit} to metres, by a comment (said once)"
    say_once(text, f"{unit} of a comment")
    return METRES[unit]


def class_ranges(class_name: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of longest side and height of a class or an alias of one, in metres."""
    if not class_name:
        raise InputError(
            "object_size class: the object has no class; name it (--class-name chair, or another "
            f"of {', '.join(CLASS_SIZES)}), or take the size in the mesh's file (--object-size "
            "file), or a number of metres"
        )
    if canonical(class_name) not in CLASS_SIZES:
        raise InputError(
            f"object_size class: no real size is known of class {class_name!r}, only of "
            f"{', '.join(CLASS_SIZES)}; take the size in the mesh's file (--object-size file), or "
            "a number of metres"
        )
    return CLASS_SIZES[canonical(class_name)]


@functools.cache
def size_name(class_name: str, original_class: str = "") -> str:
    """Return the class whose real size counts: its name, or its own if only that size is known."""
    has_size = [canonical(name) in CLASS_SIZES for name in (class_name, original_class)]
    return original_class if has_size == [False, True] else class_name


def class_size(mesh: "trimesh.Trimesh", class_name: str, rng: np.random.Generator) -> float:
    """Draw a longest side in metres for a mesh of a class, z up, uniform in the logarithm.

    Longest side and height are within the class's ranges if the mesh's proportions allow both, else
    the longest side is. The mesh is of any scale; one number is drawn.
    """
    longest, heights = class_ranges(class_name)
    side = float(mesh.extents.max())
    flatness = side / max(float(mesh.extents[2]), 1e-9 * side)
    low, high = np.clip(np.multiply(heights, flatness), *longest)
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def draw_support(class_name: str, longest: float, rng: np.random.Generator) -> float:
    """Draw the height above the floor of what an object of a class and a longest side stands on."""
    most, supports = SUPPORTS.get(canonical(class_name), (0.0, ()))
    share, place = rng.random(2).tolist()
    for part, low, high in supports if longest <= most else ():
        if share < part:
            return low + place * (high - low)
        share -= part
    return 0.0


def file_size(mesh: "trimesh.Trimesh", unit: Unit | None = None) -> tuple[float, str]:
    """Return the longest side of a mesh in metres, and its unit, see `file_unit`."""
    metres, title = file_unit(mesh, unit)
    side = float(mesh.extents.max())
    if not _LEAST <= side * metres <= _MOST:
        fix = "name its unit (units m, cm, mm or in), or "
        if mesh.units and unit:
            fix = f"leave out the unit, as this file has its own ({mesh.units}), or "
        raise InputError(
            f"object_size file: the mesh is {side:g} {title} long, which is {side * metres:g} m, "
            f"and no object of {_LEAST:g} to {_MOST:g} m; {'' if _is_known(mesh) else fix}"
            "give a size in metres (object_size)"
        )
    return side * metres, title


def file_unit(mesh: "trimesh.Trimesh", unit: Unit | None = None) -> tuple[float, str]:
    """Return the metres of one unit of a mesh, and the name of that unit.

    The first of these counts: the unit of this file alone (`MeshItem.unit`); the mesh's own unit if
    it is certain (procedural shapes, STEP, IGES); ``unit``; the unit that the file names (glTF,
    3MF, a comment); metres up to a longest side of 5, else millimetres. The log says once, of the
    first such mesh, if two differ or a unit is guessed.
    """
    side = float(mesh.extents.max())
    file = str(mesh.metadata.get("file_name", ""))
    if stated := mesh.metadata.get("unit_of_file"):
        return _metres(stated), stated
    name, note = (mesh.units if _is_known(mesh) else unit or mesh.units), ""
    if name is None:
        name = "m" if side <= _METRES_TO else "mm"
        title, where = f"{name} (guessed)", "at most" if name == "m" else "above"
        note = (
            f"does not name its unit: taken for {name}, as its longest side is {where} "
            f"{_METRES_TO:g}; say it with units (m, cm, mm or in)"
        )
    else:
        # As users name it: m for meters.
        same = (
            declared
            for declared in get_args(Unit)
            if math.isclose(_metres(declared), _metres(name))
        )
        title = next(same, name)
    if mesh.units and unit and not math.isclose(_metres(mesh.units), _metres(unit)):
        taken = f"not units {unit}" if name == mesh.units else f"but taken for units {unit}"
        note = f"is in {mesh.units} by what it says, {taken}"
        if Path(file).suffix.lower() in UNITS:  # its triangles are in another unit than the file
            declared = declared_unit(Path(file))
            note = f"is in {declared or 'the unit that it names'}, not units {unit}"
            note = "" if declared == unit else note
    if note:
        say_once(f"{file or 'a mesh'} {note}", kind=note)
    return _metres(name), title


def _is_known(mesh: "trimesh.Trimesh") -> bool:
    """Return whether the unit of the vertices is certain."""
    file = str(mesh.metadata.get("file_name", ""))
    return bool(mesh.units) and (not file or Path(file).suffix.lower() in UNITS)


def _metres(unit: str) -> float:
    from trimesh.units import unit_conversion

    try:
        return unit_conversion(unit, "m")
    except (KeyError, ValueError):
        raise InputError(
            f"the mesh's unit {unit!r} is unknown; write it in a format without units (STL, OBJ), "
            "and name it: units m or mm"
        ) from None


_NAMED = "; if not, scale some of them, or export them as 3MF or STEP, which name their unit"


def refuse_mixed(guesses: Mapping[str, str], where: str, otherwise: str = _NAMED) -> None:
    """Refuse meshes of which some are taken for metres and some for millimetres.

    Args:
        guesses: A mesh of each guessed unit.
        where: Begins the message, if it is not empty.
        otherwise: What helps if they have several units.
    """
    if len(guesses) > 1:
        raise InputError(
            f"{where}{': ' * bool(where)}{guesses['m']} would be taken for metres and "
            f"{guesses['mm']} for millimetres, by their lengths; if all have one unit, name it: "
            f"--units mm, say{otherwise}"
        )
