"""STEP and IGES before OpenCASCADE reads them: units, number of parts, and which are twice."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path, PurePosixPath

import numpy as np

from qs3.errors import InputError

UNITS = {".step": "meters", ".stp": "meters", ".iges": "millimeters", ".igs": "millimeters"}
"""Endings, and the unit that cascadio's triangles are in, whichever the file is in: of STEP it
writes metres, as glTF wants, of IGES OpenCASCADE's own millimetres."""

_MOST = 100_000
_RECORD = re.compile(rb"#(\d+)\s*=\s*([^';]*(?:'[^']*'[^';]*)*);")
_CAD = {".stp", ".step", ".p21", ".stpz", ".igs", ".iges", ".prt", ".sldprt", ".sldasm", ".asm"}
_CAD |= {".catpart", ".catproduct", ".ipt", ".iam", ".par", ".x_t", ".x_b", ".jt", ".sat", ".brep"}
_EXACT = re.compile(
    rb"(MANIFOLD_SOLID_BREP|BREP_WITH_VOIDS|FACETED_BREP\w*|\w+_BASED_(SURFACE|WIREFRAME)_MODEL"
    rb"|CSG_SOLID|SHELL_BASED_SURFACE_MODEL)\b"
)
_SHELL = re.compile(rb"(OPEN|CLOSED)_SHELL\b")
_TESSELLATED = re.compile(rb"TESSELLATED_(SOLID|SHELL|FACE\w*|CURVE_SET|CONNECTING_EDGE)\b")
_SHOWN = re.compile(b"|".join((rb"MAPPED_ITEM\b", _EXACT.pattern, _TESSELLATED.pattern)))

_SHAPE = re.compile(
    rb"\(?\s*(?!\w*(STYLE|PRE_DEFINED|ANNOTATION))"
    rb"\w*(SHELL|FACE|LOOP|EDGE|BREP|VERTEX|SURFACE|CURVE|PLANE|PLACEMENT|SHAPE_REPRESENTATION"
    rb"|REPRESENTATION_RELATIONSHIP|ITEM_DEFINED_TRANSFORMATION|MAPPED_ITEM|REPRESENTATION_MAP)"
)

_OUTSIDE = re.compile(
    rb"\(?\s*(DOCUMENT_FILE|EXTERNAL_SOURCE|APPLIED_EXTERNAL_IDENTIFICATION_ASSIGNMENT)\b"
)

_POINT = re.compile(
    rb"CARTESIAN_POINT\s*\([^(]*\(([^)]*)\)|COORDINATES_LIST\s*\('[^']*'\s*,\s*\d+\s*,([^;]*)\)"
)
_ROUND = re.compile(rb"(?:CIRCLE|ELLIPSE|\w+_SURFACE)\s*\(([^;]*)\)")
_NUMBER = re.compile(rb"(?<![#\w.])[-+]?\d+\.?\d*(?:E[-+]?\d+)?", re.IGNORECASE)
_METRES = re.compile(rb"SI_UNIT\s*\(\s*(?:\$|\.(\w+)\.)\s*,\s*\.METRE\.")
_PREFIXES = {b"": 1.0, b"DECI": 1e-1, b"CENTI": 1e-2, b"MILLI": 1e-3, b"MICRO": 1e-6, b"NANO": 1e-9}
_IGES_UNIT = re.compile(rb",([-+.\dEeDd]*),(\d+),\d+H(\w+),\d*,[-+.\dEeDd]*,1[35]H")
"""Scale of the model, number and name of the unit, before the width of lines and the date; blanks
are left out."""
_IGES_UNITS = {"1": "IN INCH", "2": "MM", "3": "IN INCH MM FT MI M KM MIL UM CM UIN", "4": "FT"}
_IGES_UNITS |= {"5": "MI", "6": "M", "7": "KM", "8": "MIL", "9": "UM", "10": "CM", "11": "UIN"}
_LARGEST_UNIT = 0.3048  # metres: a foot
_SCALED = 0.01  # difference of a matrix's squared scales that is more than rounding
_IGES_SHAPES = (108, 114, 118, 120, 122, 128, 140, 143, 144, 186, 190, 192, 194, 196, 198, 408, 430)
_IGES_NAMES = re.compile(rb"\s*(?:212|308|314|406),")
"""Entities that hold texts, and no place of a shape."""
_IGES_BASE = re.compile(rb"\s*(?:144|143\s*,\s*\d+)\s*,\s*(\d+)")
"""A trimmed face, with the surface that it is cut from: many files hide that alone."""

_APART = re.compile(rb"'[^']*'|<[^>]*>")  # texts, and places in other files
_WORD = re.compile(_APART.pattern + rb"|[a-z]+")

_NO_NUMBER = re.compile(rb"(?i)(?<=[(,])\s*([-+]?(nan|inf(inity)?)\b|-?\d\.#[a-z]\w*)")
_SI = re.compile(rb"SI_UNIT\s*\(\s*(\$|\.(MILLI|CENTI)\.)\s*,\s*\.METRE\.", re.IGNORECASE)
_INCH = re.compile(rb"CONVERSION_BASED_UNIT\s*\(\s*'INCH'", re.IGNORECASE)
_NAMES = {b"$": "m", b".MILLI.": "mm", b".CENTI.": "cm"}

Links = Mapping[int, Sequence[int]]


def prepare(step: bytes) -> tuple[bytes, list[str], list[str]]:
    """Return STEP without twins and hidden shapes, files of other parts, and parts without a place.

    Refused are shapes that name missing records, as OpenCASCADE leaves their faces out, and a file
    that places more parts than it can copy: assemblies and mapped items within each other hold any
    number in few bytes.
    """
    if b"/*" in step:
        step = re.sub(rb"('[^']*')|/\*.*?\*/", rb"\1", step, flags=re.DOTALL)
    plain = _APART.sub(b"", step)
    _check_numbers(plain)
    # .milli. is .MILLI., but not for OpenCASCADE; a letter alone is that of 1.e-3.
    if re.search(rb"[a-z]{2}|\.[tfu]\.", plain):
        step = _WORD.sub(
            lambda found: found[0] if found[0][:1] in b"'<" else found[0].upper(), step
        )
    records = {int(number): text.strip() for number, text in _RECORD.findall(step)}
    parts = {
        number: _names(text)[:2]
        for number, text in records.items()
        if text.startswith(b"NEXT_ASSEMBLY_USAGE_OCCURRENCE")
    }
    uses: dict[int, list[int]] = {}
    for whole, part in parts.values():
        uses.setdefault(whole, []).append(part)
    maps = {
        number: _names(text)
        for number, text in records.items()
        if re.match(rb"(MAPPED_ITEM|REPRESENTATION_MAP|\w*REPRESENTATION)\s*\(", text)
    }
    for links in (
        uses,
        {key: [name for name in names if name in maps] for key, names in maps.items()},
    ):
        _check_parts(links)
    _check_names(step, records)
    point = b"CARTESIAN_POINT('',(0.,0.,0.))"  # is no shape
    other = dict.fromkeys(_twins(records) | _hidden(records), point) | _placements(records)
    step = (
        _RECORD.sub(lambda row: b"#%b=%b;" % (row[1], other.get(int(row[1]), row[2])), step)
        if other
        else step
    )
    return step, _other_files(step, records), _unplaced(records, parts, uses) if parts else []


def declared_unit(path: Path) -> str:
    """Return the unit that a STEP or IGES file names: m, cm, mm or in; empty for any other."""
    data = path.read_bytes() if path.is_file() else b""
    if UNITS[path.suffix.lower()] == "meters":
        if _INCH.search(data):
            return "in"
        found = _SI.search(data)
        return "" if found is None else _NAMES[found[1].upper()]
    # The global section, without the ends of its lines: …, flag, unit as 2HMM, …
    lines = [line[:72] for line in data.splitlines() if line[72:73] == b"G"]
    found = re.search(rb",[1-9]\d*,[12]H(IN|MM|CM|M)[,;]", b"".join(lines))
    return "" if found is None else found[1].decode().lower()


def has_length_unit(step: bytes) -> bool:
    """Return whether a context of a STEP file has a unit of length."""
    units = set(re.findall(rb"#(\d+)\s*=[^;]*?\bLENGTH_UNIT\b", step))
    named = re.findall(rb"GLOBAL_UNIT_ASSIGNED_CONTEXT\s*\(\s*\(([^)]*)\)", step)
    return any(units.intersection(re.findall(rb"#(\d+)", names)) for names in named)


def longest_side(step: bytes) -> float:
    """Return the length in metres that no side of a STEP file exceeds; infinite if unknown.

    It is twice the largest distance of a point from the others, or the largest radius.
    """
    units = [_PREFIXES.get(prefix.upper(), np.inf) for prefix in _METRES.findall(step)]
    if not units:
        return np.inf
    unit = max([*units, *[_LARGEST_UNIT] * (b"CONVERSION_BASED_UNIT" in step)])
    numbers = [_NUMBER.findall(one or two) for one, two in _POINT.findall(step)]
    points = np.array([number for row in numbers for number in row], dtype=np.float64)
    radii = np.array([n for row in _ROUND.findall(step) for n in _NUMBER.findall(row)], np.float64)
    if not len(points) or len(points) % 3:
        return np.inf
    sides = np.ptp(points.reshape(-1, 3), axis=0)
    return 2 * unit * float(max(sides.max(), np.abs(radii).max(initial=0)))


def _check_names(step: bytes, records: Mapping[int, bytes]) -> None:
    """Refuse shapes that name missing records, except those of a section REFERENCE."""
    named = {int(name) for name in re.findall(rb"#(\d+)", re.sub(rb"'[^']*'", b"", step))}
    elsewhere = {int(name) for name in re.findall(rb"#(\d+)\s*=\s*<", step)}
    if missing := named - elsewhere - records.keys():
        for number, text in records.items():
            if _SHAPE.match(text) and (lost := missing.intersection(_names(text))):
                raise InputError(f"#{number} names #{min(lost)}, which is missing: it is damaged")


def _hidden(records: Mapping[int, bytes]) -> set[int]:
    """Return the shapes that are marked as invisible, unless there are no others.

    So are a shell of such faces alone, and a shape of such shells.
    """
    todo = [
        marked
        for text in records.values()
        if re.match(rb"INVISIBILITY\s*\(", text)
        for marked in _names(text)
    ]
    named: set[int] = set()
    while todo:
        if (number := todo.pop()) in named:
            continue
        named.add(number)
        text = records.get(number, b"")
        if text.startswith(b"PRESENTATION_LAYER_ASSIGNMENT"):
            todo += _names(text)
        elif match := re.match(rb"(OVER_RIDING_)?STYLED_ITEM\b", text):
            todo += _names(text)[-2:-1] if match[1] else _names(text)[-1:]
    for kind in (_SHELL, _EXACT) if named else ():
        whole = ((number, _names(text)) for number, text in records.items() if kind.match(text))
        named |= {number for number, parts in whole if parts and named.issuperset(parts)}
    shapes = {
        number
        for number, text in records.items()
        if (_EXACT.match(text) or _TESSELLATED.match(text)) and b"REPRESENTATION" not in text[:60]
    }
    hidden = named & shapes
    return hidden if shapes - hidden else set()


def _placements(records: Mapping[int, bytes]) -> dict[int, bytes]:
    """Return as placements the operators that place mapped items; OpenCASCADE reads no operators.

    One that scales or mirrors is refused.
    """
    operators = {
        number: text
        for number, text in records.items()
        if text.startswith(b"CARTESIAN_TRANSFORMATION_OPERATOR_3D")
    }
    placed: dict[int, bytes] = {}
    for text in records.values() if operators else ():
        is_item = text.startswith(b"MAPPED_ITEM")
        if not is_item and b"REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION" not in text:
            continue
        for number in operators.keys() & set(_names(text)):
            words = re.findall(rb"#\d+|\$|[-+.\dEe]+", re.sub(rb"'[^']*'", b"", operators[number]))
            one, two, origin, scale, three = words[-5:]
            x, y, z = (
                default if name == b"$" else _numbers(records[int(name[1:])])
                for name, default in zip((one, two, three), np.eye(3), strict=True)
            )
            is_moved = np.dot(np.cross(x, y), z) > 0 and (scale == b"$" or float(scale) == 1)
            if not is_item or not is_moved:
                raise InputError(
                    f"#{number} mirrors or scales a part, which is not read; export its shape as "
                    "it stands"
                )
            placed[number] = b"AXIS2_PLACEMENT_3D('',%b,%b,%b)" % (origin, three, one)
    return placed


def _numbers(text: bytes) -> np.ndarray:
    """Return the numbers of a direction."""
    return np.array(re.findall(rb"[-+.\dEe]+", text.partition(b"',")[2]), dtype=np.float64)


def check_iges(iges: bytes) -> None:
    """Refuse a file that is cut short, or whose subfigures (308, 408) place over 100,000 parts.

    So are a unit whose number and name differ or are unknown, a scale, hidden shapes beside visible
    ones, and parts that are stretched: OpenCASCADE reads the number, takes millimetres, leaves the
    scale out, and shows what is hidden.
    """
    texts: dict[int, bytes] = {}
    lines = iges.rstrip(b" \t\r\n\0\x1a").splitlines()
    held = Counter(line[72:73] for line in lines)
    declared = [re.match(rb"S *\d+G *\d+D *(\d+)P *(\d+)", line) for line in lines[-3:]]
    ends = [tuple(map(int, found.groups())) for found in declared if found]
    if ends != [(held[b"D"], held[b"P"])]:
        raise InputError(
            f"has {held[b'D']} and {held[b'P']} lines of entities, and ends with the counts "
            f"{ends or 'missing'}; the file is cut short"
        )
    head = b"".join(b"".join(line[:72].split()) for line in lines if line[72:73] == b"G")
    if found := _IGES_UNIT.search(head):
        scale, flag, name = (word.decode() for word in found.groups())
        if (name if flag == "3" else name.upper()) not in _IGES_UNITS.get(flag, "MM").split():
            raise InputError(f"has unit {flag} and calls it {name}; export it again in millimetres")
        if scale and float(scale.upper().replace("D", "E")) != 1:
            raise InputError(f"is a model at scale {scale}; export it at scale 1")
    for line in lines:
        if line[72:73] == b"P":
            key = int(line[64:72])
            texts[key] = texts.get(key, b"") + line[:64]
    _check_numbers(b"".join(text for text in texts.values() if not _IGES_NAMES.match(text)))
    links: dict[int, list[int]] = {}
    for key, text in texts.items():
        name = re.match(rb"\s*308,[^,]*,(\d+)H", text)
        if name or re.match(rb"\s*408,", text):
            words = re.split(b"[,;]", text[name.end() + int(name[1]) :] if name else text)
            below = words[2:] if name else words[1:2]
            links[key] = [int(word) for word in below if word.strip().isdigit()]
    _check_parts({key: [n for n in names if n in links] for key, names in links.items()})
    _check_placings(texts.values())
    bases = {int(found[1]) for text in texts.values() if (found := _IGES_BASE.match(text))}
    states = [
        line[64:68].replace(b" ", b"0")
        for line in lines
        if line[72:73] == b"D"
        and int(line[73:80]) % 2
        and int(line[:8]) in _IGES_SHAPES
        and int(line[73:80]) not in bases
    ]
    is_hidden = [state[:2] == b"01" for state in states if state[2:] != b"01"]  # no part of another
    if any(is_hidden) and not all(is_hidden):
        raise InputError(
            f"{sum(is_hidden)} of its {len(is_hidden)} shapes are hidden (blanked) and would be "
            "read too; export the visible ones alone"
        )


def _check_placings(texts: Iterable[bytes]) -> None:
    """Refuse matrices (124) that stretch or shear, and subfigures (408) of a negative scale.

    OpenCASCADE leaves the stretch out, and puts such a subfigure elsewhere.
    """
    for text in texts:
        if (found := re.match(rb"\s*(124|408),([^;]*)", text)) is None:
            continue
        words = b"".join(found[2].split()).upper().replace(b"D", b"E").split(b",")[:12]
        values = [float(word) if word else 0.0 for word in words]
        is_scaled = found[1] == b"408" and min(values[4:5], default=0.0) < 0
        if found[1] == b"124":
            # Zeros at its end may be left out.
            turn = np.array([*values, *[0.0] * (12 - len(values))]).reshape(3, 4)[:, :3]
            square = turn @ turn.T
            largest = square.diagonal().max()
            is_scaled = np.abs(square - largest * np.eye(3)).max() > _SCALED * largest
        if is_scaled:
            raise InputError(
                f"a part is mirrored, stretched or sheared where it is placed (entity "
                f"{found[1].decode()}), which is not read; export its shape as it stands"
            )


def _check_numbers(text: bytes) -> None:
    """Refuse NaN and infinity, which OpenCASCADE takes for 0."""
    if found := _NO_NUMBER.search(text):
        raise InputError(f"holds {found[1].decode()}, which is no number; export it again")


def _check_parts(links: Links) -> None:
    """Refuse parts that hold each other in a circle, or over 100,000 when all are placed."""
    counts: dict[int, int] = {}
    try:
        for part in TopologicalSorter(links).static_order():
            counts[part] = sum(counts[below] for below in links.get(part, ())) or 1
            if counts[part] > _MOST:
                raise InputError(f"places over {_MOST} parts; split it")
    except CycleError as error:
        raise InputError(f"parts hold each other in a circle: #{error.args[1][0]}") from None


def _names(text: bytes) -> list[int]:
    """Return the records that a record names, in order."""
    return [int(name) for name in re.findall(rb"#(\d+)", re.sub(rb"'[^']*'", b"", text))]


def _twins(records: Mapping[int, bytes]) -> set[int]:
    """Return the tessellated shapes that a product also has as an exact one (AP242)."""
    tessellated = {number for number, text in records.items() if _TESSELLATED.match(text)}
    if not tessellated:
        return set()
    items, top = _representations(records)
    exact = {
        top(number)
        for number, names in items.items()
        if any(_EXACT.match(records.get(name, b"")) for name in names)
    }
    apart = {
        name
        for number, names in items.items()
        if top(number) in exact and not any(_EXACT.match(records.get(name, b"")) for name in names)
        for name in names
    }
    linked = {
        number
        for number in tessellated
        if any(_EXACT.match(records.get(name, b"")) for name in _names(records[number]))
    }
    return tessellated & (apart | linked)


def _representations(
    records: Mapping[int, bytes],
) -> tuple[dict[int, list[int]], Callable[[int], int]]:
    """Return the items of representations, and a function with one number for all of one shape.

    These are a product's, and those that a relationship without a placement calls the same shape.
    """
    items = {
        number: _names(text)
        for number, text in records.items()
        if re.match(rb"\w*REPRESENTATION\s*\(", text)
    }
    owner = {number: number for number in items}

    def top(number: int) -> int:
        while owner.get(number, number) != number:
            number = owner[number]
        return number

    for text in records.values():
        if re.match(rb"SHAPE_(DEFINITION_REPRESENTATION|REPRESENTATION_RELATIONSHIP)\s*\(", text):
            one, other = (*_names(text), 0, 0)[:2]
            if text.startswith(b"SHAPE_D"):  # the product that a PRODUCT_DEFINITION_SHAPE names
                one = (*_names(records.get(one, b"")), 0)[0]
                owner.setdefault(one, one)
            if one in owner and other in owner:
                owner[top(one)] = top(other)
    return items, top


def _unplaced(
    records: Mapping[int, bytes], parts: Mapping[int, Sequence[int]], uses: Links
) -> list[str]:
    """Return the uses of parts that have a shape and no place: OpenCASCADE leaves them out.

    A relationship with a transformation places a use; a mapped item places all uses of its shape.
    """
    items, top = _representations(records)
    maps = (text for text in records.values() if text.startswith(b"REPRESENTATION_MAP"))
    placed, shown = {top(name) for text in maps for name in _names(text)[-1:]}, set[int]()
    for number, names in items.items():
        texts = [records.get(name, b"") for name in names]
        if any(map(_SHOWN.match, texts)):
            shown.add(top(number))
        elif any(b"WITH_TRANSFORMATION" in text for text in texts[:1]):
            placed |= {*_names(texts[-1])}
    for product in TopologicalSorter(uses).static_order():  # parts come before what holds them
        if top(product) in shown or shown.intersection(uses.get(product, ())):
            shown.add(product)
    return [
        f"#{use}"
        for use, (whole, part) in parts.items()
        if part in shown and not placed & {use, top(part)} and top(whole) != top(part)
    ]


def _other_files(step: bytes, records: Mapping[int, bytes]) -> list[str]:
    """Return the CAD files that a file names: its parts lie there."""
    found = re.findall(rb"#\d+\s*=\s*<([^>#]+)", step)  # of a section REFERENCE
    for text in records.values():
        if _OUTSIDE.match(text):
            found += re.findall(rb"'([^']+)'", text)
    names = dict.fromkeys(name.decode("latin-1") for name in found)
    return [name for name in names if PurePosixPath(name.lower()).suffix in _CAD]
