"""3MF: the objects of its build, placed by their components' transforms."""

import re
import zipfile
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from qs3.errors import InputError
from qs3.meshes.polygons import Part, check_placed, merge, place, size_of

_READ = re.compile("/(core|production|material|trianglesets)/")
_MOST_BYTES = 1 << 30  # XML takes many times its size in memory
_ROOT = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"

Key = tuple[str, str]
"""Path of a part of the archive, and the id of an object in it."""
Placed = tuple[Key, np.ndarray]  # with its matrix


def read_3mf(path: Path) -> tuple[list[Part], str]:
    """Read all items of the build, and the unit that they are in.

    An object's id counts in its own part of the archive alone.
    """
    objects: dict[Key, tuple[Part, list[Placed]]] = {}
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(info.file_size for info in archive.infolist())
        if unpacked > _MOST_BYTES:
            raise InputError(f"unpacks to {unpacked} bytes, over {_MOST_BYTES}; split it")
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
            uses = [*build, *(use for _, components in found.values() for use in components)]
            named = {key[0] for key, _ in uses} - seen
            todo += sorted(named)
            seen |= named
    placed = _placed(objects)
    if missing := [key for key, _ in items if key not in placed]:
        raise _missing(missing[0])
    check_placed(sum(size_of(placed[key]) for key, _ in items))
    return [place(placed[key], matrix) for key, matrix in items], unit


def _root(archive: zipfile.ZipFile, names: dict[str, zipfile.ZipInfo]) -> str:
    """Return the part that the package's relations name as its model."""
    relations = archive.read(names["/_rels/.rels"]) if "/_rels/.rels" in names else b"<none/>"
    for relation in ElementTree.fromstring(relations):  # noqa: S314
        if relation.get("Type") == _ROOT:
            return "/" + relation.attrib["Target"].lstrip("/").lower()
    return "/3d/3dmodel.model"


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
                for prefix in element.get("requiredextensions", "").split():
                    space = str(spaces.get(prefix, prefix))
                    if not _READ.search(space):
                        raise InputError(f"requires the extension {space}, which is not read")
        elif name == "object":
            components = [_placing(e, part) for e in element.iter() if _tag(e) == "component"]
            objects[part, element.attrib["id"]] = _mesh(element), components
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
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), corners


def _placing(element: ElementTree.Element, part: str) -> Placed:
    """Return the object that a component or an item names, and its matrix."""
    path = next((value for key, value in element.attrib.items() if key.endswith("}path")), part)
    matrix = np.eye(4)
    if text := element.get("transform"):
        matrix[:3] = np.array(text.split(), dtype=np.float64).reshape(4, 3).T
    return ("/" + path.lstrip("/").lower(), element.attrib["objectid"]), matrix


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
