"""3MF: the objects of its build, placed by their components' transforms."""

import posixpath
import re
import zipfile
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from qs3.errors import InputError, say_once
from qs3.meshes.polygons import Part, check_placed, merge, place, size_of

_READ = re.compile("/(core|production|material|trianglesets)/")
_MOST_BYTES = 1 << 30  # XML takes many times its size in memory
_ROOT = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"

_PARTS = ("modelpart", "normal_part")
"""Volumes that are part of the product, as PrusaSlicer and Bambu Studio call them."""
_UNPRINTED = ("support", "solidsupport", "other")
_CURA = re.compile("cura:(anti_overhang|cutting|infill|support)_mesh")

_UNITS = ("micron", "millimeter", "centimeter", "inch", "foot", "meter")
_SHAPES = ("beamlattice", "booleanshape", "displacementmesh", "levelset")
"""Elements of extensions that change a shape, whether or not the file requires them."""

Key = tuple[str, str]
"""Path of a part of the archive, and the id of an object in it."""
Placed = tuple[Key, np.ndarray]  # with its matrix


def read_3mf(path: Path) -> tuple[list[Part], str]:
    """Read the items of the build that are printed, and the unit that they are in.

    An object's id counts in its own part of the archive alone. Supports, and what slicers mark as
    modifiers or blockers, are left out.
    """
    objects: dict[Key, tuple[Part, list[Placed]]] = {}
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(info.file_size for info in archive.infolist())
        if unpacked > _MOST_BYTES:
            raise InputError(f"unpacks to {unpacked} bytes, over {_MOST_BYTES}; split it")
        names = {_part(info.filename): info for info in archive.infolist()}
        root = _root(archive, names)
        items, unit = [], ""
        todo, seen = [root], {root}
        while todo:
            if todo[-1] not in names:
                raise InputError(f"names the part {todo[-1]}, which it does not hold")
            with archive.open(names[part := todo.pop()]) as stream:
                found, build, part_unit = _parse(stream, part)
            if part == root:
                items, unit = build, part_unit
            elif part_unit != unit:
                raise InputError(f"{part} is in {part_unit}, its root in {unit}; export it again")
            objects |= found
            uses = [*build, *(use for _, components in found.values() for use in components)]
            named = {key[0] for key, _ in uses} - seen
            todo += sorted(named)
            seen |= named
        _remove_helpers(archive, names, root, objects)
    placed = _placed(objects)
    if missing := [key for key, _ in items if key not in placed]:
        raise _missing(missing[0])
    check_placed(sum(size_of(placed[key]) for key, _ in items))
    parts = [place(placed[key], matrix) for key, matrix in items if len(placed[key][1])]
    if not parts:
        empty = "its build has no item to print: place the part on the plate, or export it as STL"
        why = "supports and modifiers are left out" if items else empty
        raise InputError(f"has no faces that are printed; {why}")
    if len(parts) > 1:
        say_once(
            f"{path}: holds {len(parts)} items of a build, taken for one part; if they are several "
            "on a print plate, save each as a file of its own"
        )
    return parts, unit


def _remove_helpers(
    archive: zipfile.ZipFile,
    names: dict[str, zipfile.ZipInfo],
    root: str,
    objects: dict[Key, tuple[Part, list[Placed]]],
) -> None:
    """Remove triangles and components that a slicer's settings mark as no part of the product."""
    for name in names:
        if not re.fullmatch(r"/metadata/.*model.*\.config", name):
            continue
        for element in ElementTree.fromstring(archive.read(names[name])).iter("object"):  # noqa: S314
            key = root, element.get("id", "")
            if key not in objects:
                continue
            (vertices, faces), components = objects[key]
            kept = np.ones(len(faces), dtype=bool)
            for volume in (*element.iter("volume"), *element.iter("part")):
                settings = {e.get("key"): e.get("value", "") for e in volume.iter("metadata")}
                modifier = "modifier" if settings.get("modifier") == "1" else _PARTS[0]
                kind = (volume.get("subtype") or settings.get("volume_type") or modifier).lower()
                if kind in _PARTS:
                    continue
                if kind.startswith("negative"):
                    say_once(f"{archive.filename}: its negative volumes are left out, not cut away")
                if volume.tag == "volume":
                    first, last = (int(volume.attrib[at]) for at in ("firstid", "lastid"))
                    kept[max(first, 0) : last + 1] = False
                else:
                    components = [c for c in components if c[0][1] != volume.get("id")]
            objects[key] = (vertices, faces[kept]), components


def _root(archive: zipfile.ZipFile, names: dict[str, zipfile.ZipInfo]) -> str:
    """Return the part that the package's relations name as its model."""
    relations = archive.read(names["/_rels/.rels"]) if "/_rels/.rels" in names else b"<none/>"
    for relation in ElementTree.fromstring(relations):  # noqa: S314
        if relation.get("Type") == _ROOT:
            return _part(relation.attrib["Target"])
    return "/3d/3dmodel.model"


def _part(name: str) -> str:
    """Return one name for each part of a package, whose names are percent-encoded."""
    return posixpath.normpath("/" + unquote(name).replace("\\", "/").lstrip("/")).lower()


def _parse(
    stream: Any, part: str
) -> tuple[dict[Key, tuple[Part, list[Placed]]], list[Placed], str]:
    """Return the objects of a part, the items of its build, and its unit."""
    objects: dict[Key, tuple[Part, list[Placed]]] = {}
    spaces: dict[str, str] = {}
    items, unit = [], "millimeter"
    for event, element in ElementTree.iterparse(stream, ("start-ns", "start", "end")):  # noqa: S314
        if event == "start-ns":
            spaces[element[0]] = element[1]
            continue
        name = _tag(element)
        if event == "start":
            if name == "model":
                unit = element.get("unit", unit)
                if unit not in _UNITS:
                    raise InputError(f"its unit {unit!r} is unknown; known are {', '.join(_UNITS)}")
                for prefix in element.get("requiredextensions", "").split():
                    space = str(spaces.get(prefix, prefix))
                    if not _READ.search(space):
                        raise InputError(f"requires the extension {space}, which is not read")
        elif name == "object":
            _check_shape(element)
            if (part, element.attrib["id"]) in objects:
                raise InputError(f"{part} has the object {element.attrib['id']} twice")
            components = [_placing(e, part) for e in element.iter() if _tag(e) == "component"]
            mesh = _mesh(element)
            if element.get("type", "model") in _UNPRINTED or _is_modifier(element):
                mesh, components = (mesh[0], mesh[1][:0]), []
            objects[part, element.attrib["id"]] = mesh, components
            element.clear()
        elif name == "item" and element.get("printable", "1") not in ("0", "false"):
            items.append(_placing(element, part))
    return objects, items, unit


def _check_shape(element: ElementTree.Element) -> None:
    """Refuse an object whose shape is not that of its triangles."""
    found = [tag for tag in map(_tag, element.iter()) if tag in _SHAPES]
    resolution = [value for key, value in element.attrib.items() if key.endswith("}meshresolution")]
    if found or "lowres" in resolution:
        kind = found[0] if found else "shape of slices"
        raise InputError(f"has a {kind}, which is not read; export triangles")


def _is_modifier(element: ElementTree.Element) -> bool:
    """Whether Cura's settings of an object make it no part of the product."""
    return any(
        _CURA.fullmatch(row.get("name", "")) and (row.text or "").strip().lower() == "true"
        for row in element.iter()
        if _tag(row) == "metadata"
    )


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _mesh(element: ElementTree.Element) -> Part:
    rows = [(_tag(row), row.attrib) for row in element.iter()]
    vertices = [[float(row[key]) for key in "xyz"] for tag, row in rows if tag == "vertex"]
    faces = [[int(row[f"v{i}"]) for i in (1, 2, 3)] for tag, row in rows if tag == "triangle"]
    corners = np.array(faces, dtype=np.int64).reshape(-1, 3)
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), corners


def _placing(element: ElementTree.Element, part: str) -> Placed:
    """Return the object that a component or an item names, and its matrix."""
    path = next((value for key, value in element.attrib.items() if key.endswith("}path")), part)
    matrix = np.eye(4)
    if text := element.get("transform"):
        matrix[:3] = np.array(text.split(), dtype=np.float64).reshape(4, 3).T
    return (_part(path), element.attrib["objectid"]), matrix


def _placed(objects: dict[Key, tuple[Part, list[Placed]]]) -> dict[Key, Part]:
    below = {key: [child for child, _ in components] for key, (_, components) in objects.items()}
    placed: dict[Key, Part] = {}
    sizes: dict[Key, int] = {}
    try:
        order = list(TopologicalSorter(below).static_order())
    except CycleError as error:
        raise InputError(f"parts hold each other in a circle: {error.args[1][0]}") from None
    for key in order:
        if key not in objects:
            raise _missing(key)
        sizes[key] = size_of(objects[key][0]) + sum(sizes[child] for child in below[key])
        check_placed(sizes[key])
    for key in order:
        mesh, components = objects[key]
        placed[key] = merge([mesh, *(place(placed[child], m) for child, m in components)])
    return placed


def _missing(key: Key) -> InputError:
    return InputError(f"names object {key[1]} of {key[0]}, which is not there")
