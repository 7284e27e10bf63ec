"""3MF: the objects of its build, placed by their components' transforms."""

import re
import zipfile
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from qs3.errors import InputError
from qs3.meshes.polygons import Part, check_indices, check_placed, count_placed, merge, place
from qs3.reading import check_size

_READ = re.compile("/(core|production|material|trianglesets)/")
_ROOT = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"

Key = tuple[str, str]
"""Path of a part of the archive, and the id of an object in it."""


class _Object(NamedTuple):
    mesh: Part
    components: list[tuple[Key, np.ndarray]]


def read_3mf(path: Path) -> tuple[list[Part], str]:
    """Read all items of the build, and the unit that they are in.

    An object's id counts in its own part of the archive alone.
    """
    objects: dict[Key, _Object] = {}
    with zipfile.ZipFile(path) as archive:
        check_size("the unpacked file", sum(info.file_size for info in archive.infolist()))
        names = {f"/{info.filename}".lower(): info for info in archive.infolist()}
        root = _root(archive, names)
        items, unit = [], ""
        todo, seen = [root], {root}
        while todo:
            if todo[-1] not in names:
                raise InputError(f"names the part {todo[-1]}, which it does not hold")
            with archive.open(names[part := todo.pop()]) as stream:
                found, build, own_unit = _parse(stream, part)
            if part == root:
                items, unit = build, own_unit
            elif own_unit != unit:
                raise InputError(f"{part} is in {own_unit}, its root in {unit}; export it again")
            objects |= found
            keys = [key for each in found.values() for key, _ in each.components]
            named = {key[0] for key in keys + [key for key, _ in build]} - seen
            todo += sorted(named)
            seen |= named
    placed = _placed(objects, items)
    return [place(placed[key], matrix) for key, matrix in items], unit


def _root(archive: zipfile.ZipFile, names: dict[str, zipfile.ZipInfo]) -> str:
    """Return the part that the package's relations name as its model."""
    relations = archive.read(names["/_rels/.rels"]) if "/_rels/.rels" in names else b"<none/>"
    for relation in ElementTree.fromstring(relations):  # noqa: S314
        if relation.get("Type") == _ROOT:
            return "/" + relation.attrib["Target"].lstrip("/").lower()
    return "/3d/3dmodel.model"


def _parse(stream: Any, part: str) -> tuple[dict[Key, _Object], list[Any], str]:
    """Return the objects of a part, the items of its build, and its unit."""
    objects: dict[Key, _Object] = {}
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
                for prefix in element.get("requiredextensions", "").split():
                    space = str(spaces.get(prefix, prefix))
                    if not _READ.search(space):
                        raise InputError(f"requires the extension {space}, which is not read")
        elif name == "object":
            children = [_placing(e, part) for e in element.iter() if _tag(e) == "component"]
            objects[part, element.attrib["id"]] = _Object(_mesh(element), children)
            element.clear()
        elif name == "item":
            items.append(_placing(element, part))
    return objects, items, unit


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _mesh(element: ElementTree.Element) -> Part:
    rows = [(_tag(row), row.attrib) for row in element.iter()]
    vertices = [[float(row[key]) for key in "xyz"] for tag, row in rows if tag == "vertex"]
    faces = [[int(row[f"v{i}"]) for i in (1, 2, 3)] for tag, row in rows if tag == "triangle"]
    corners = np.array(faces, dtype=np.int64).reshape(-1, 3)
    check_indices(corners, len(vertices))
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), corners


def _placing(element: ElementTree.Element, part: str) -> tuple[Key, np.ndarray]:
    """Return the object that a component or an item names, and its matrix."""
    path = next((value for key, value in element.attrib.items() if key.endswith("}path")), part)
    matrix = np.eye(4)
    if text := element.get("transform"):
        matrix[:3] = np.array(text.split(), dtype=np.float64).reshape(4, 3).T
    return ("/" + path.lstrip("/").lower(), element.attrib["objectid"]), matrix


def _placed(objects: dict[Key, _Object], items: list[tuple[Key, np.ndarray]]) -> dict[Key, Part]:
    """Return each object with its components; count the triangles before."""
    below = {key: [child for child, _ in each.components] for key, each in objects.items()}
    for part, name in [
        *(key for key, _ in items),
        *(key for each in below.values() for key in each),
    ]:
        if (part, name) not in objects:
            raise InputError(f"names object {name} of {part}, which is not there")
    counts = count_placed(below, {key: len(each.mesh[1]) for key, each in objects.items()})
    check_placed(max(sum(counts[key] for key, _ in items), *counts.values()))
    placed: dict[Key, Part] = {}
    for key in counts:
        moved = [place(placed[child], matrix) for child, matrix in objects[key].components]
        placed[key] = merge([objects[key].mesh, *moved])
    return placed
