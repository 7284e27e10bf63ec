"""glTF 2.0 (.gltf, .glb): the triangles of its default scene, placed by its nodes."""

import base64
import json
import re
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import InputError, say_once
from qs3.meshes.polygons import Part, check_placed, place, size_of, stray, strip
from qs3.reading import reading

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_HARMLESS = re.compile(
    "KHR_(mesh_quantization|node|materials|texture|lights|xmp|animation)"
    "|(EXT|MSFT)_(texture|lights|lod|mesh_features|structural_metadata)|FB_ngon|CESIUM_primitive"
)
"""Extensions that may be required: they leave triangles as they are, or need nothing more."""
_TOLERANCE = 1e-3
"""Difference of positions from their declared box, as a share of its longest side."""
_STRAY = 0.25
"""Share of a part's size by which a face of CAD may bulge beyond its edges without a warning."""


def read_gltf(path: Path, data: bytes) -> list[Part]:
    """Read each primitive of triangles, in the axes of the scene and metres.

    Points, lines and hidden nodes (KHR_node_visibility) are left out. Skins and morphed shapes are
    refused.
    """
    binary = b""
    if data[:4] == b"glTF":
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2:
            raise InputError(f"is binary glTF {version}; only 2 is read: convert it")
        if length > len(data):
            raise InputError(f"declares {length} bytes, but has {len(data)}; it is cut short")
        at, chunks = 12, {}
        while at + 8 <= length:
            size, kind = struct.unpack_from("<I4s", data, at)
            chunks.setdefault(kind, data[at + 8 : at + 8 + size])
            at += 8 + size
        data, binary = chunks[b"JSON"], chunks.get(b"BIN\0", b"")
    tree = json.loads(data.removeprefix(b"\xef\xbb\xbf"))
    tree |= {key: _Items(value) for key, value in tree.items() if isinstance(value, list)}
    asset = tree.get("asset", {})
    version = str(asset.get("minVersion", asset.get("version")))
    if version.partition(".")[0] != "2" or ("minVersion" in asset and version != "2.0"):
        raise InputError(f"is glTF {version}; only 2.0 is read: convert it")
    for name in tree.get("extensionsRequired", []):
        if not _HARMLESS.match(name):
            raise InputError(f"requires the extension {name}, which is not read; export without it")
    accessors = _Accessors(tree, path, binary)
    read: dict[int, list[Part]] = {}
    placed = []
    for node, matrix in _placed_nodes(tree):
        if "mesh" in node:
            key, mesh = node["mesh"], tree["meshes"][node["mesh"]]
            if "skin" in node or any(node.get("weights", mesh.get("weights", []))):
                raise InputError(
                    "has a skin or a morphed shape, which is not read; export its pose"
                )
            if key not in read:
                read[key] = [accessors.part(p) for p in mesh["primitives"] if p.get("mode", 4) > 3]
            placed += [(part, matrix) for part in read[key]]
    check_placed(sum(size_of(part) for part, _ in placed))
    return [place(part, matrix) for part, matrix in placed]


class _Items(list[Any]):
    """Items that have no negative index."""

    def __getitem__(self, index: Any) -> Any:
        if index < 0:
            raise InputError(f"names item {index} of a list; the file is damaged")
        return super().__getitem__(index)


def _placed_nodes(tree: dict[str, Any]) -> list[tuple[dict[str, Any], Float[np.ndarray, "4 4"]]]:
    nodes, scenes = tree.get("nodes", []), tree.get("scenes")
    children = {child for node in nodes for child in node.get("children", [])}
    for node in nodes:  # its coarser forms are nodes too
        children |= {*node.get("extensions", {}).get("MSFT_lod", {}).get("ids", [])}
    roots = [index for index in range(len(nodes)) if index not in children]
    if scenes:
        roots = scenes[tree.get("scene", 0)].get("nodes", [])
    placed, seen = [], set()
    todo = [(index, np.eye(4)) for index in roots]
    while todo:
        index, matrix = todo.pop()
        node = nodes[index]
        if index in seen:
            raise InputError(f"node {index} has two parents, or is below itself")
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise InputError("uses the extension EXT_mesh_gpu_instancing, which is not read")
        seen.add(index)
        if not node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True):
            continue  # with all below it
        placed.append((node, matrix := matrix @ _matrix(node)))
        todo += [(child, matrix) for child in node.get("children", [])]
    return placed


def _matrix(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Return the matrix of a node below its parent: its own, or T · R · S."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
        if not np.allclose(matrix[3], (0, 0, 0, 1)):
            raise InputError(f"a node's matrix ends in {matrix[3].tolist()}, not in 0 0 0 1")
        return matrix
    matrix, quaternion = np.eye(4), np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix[:3, :3] += 2 * (w * cross + cross @ cross)
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _triangles(corners: Int[np.ndarray, "n"], mode: int) -> Int[np.ndarray, "m 3"]:
    if mode == 4:
        return corners.reshape(-1, 3)
    if mode == 5:
        return strip(corners)
    if mode != 6:
        raise InputError(f"has a primitive of mode {mode}, which is unknown; the file is damaged")
    return np.stack([corners[1:-1], corners[2:], np.full_like(corners[2:], corners[0])], axis=1)


class _Accessors:
    def __init__(self, tree: dict[str, Any], path: Path, binary: bytes) -> None:
        self._tree, self._folder, self._binary = tree, path.parent, binary
        self._name = path
        self._buffers: dict[int, bytes] = {}

    def part(self, primitive: dict[str, Any]) -> Part:
        points = self._positions(primitive["attributes"]["POSITION"])
        index = primitive.get("indices")
        corners = np.arange(len(points)) if index is None else self._rows(index)[:, 0]
        if corners.dtype.kind == "f":
            raise InputError(f"accessor {index}: indices are no whole numbers")
        part = points, _triangles(corners.astype(np.int64), primitive.get("mode", 4))
        if faces := primitive.get("extensions", {}).get("TM_brep_faces"):  # of cascadio
            types = [face and face["type"] for face in faces["faces"]]
            owners = self._rows(faces["faceIndices"])[:, 0].astype(np.int64)
            is_round = [at for at, kind in enumerate(types) if kind in ("sphere", "torus")]
            out, size = stray(part, owners, is_round)
            if out > _STRAY * size > 0:
                say_once(
                    f"{self._name}: a face reaches {out:.3g} m beyond its own edges, and the edges "
                    f"of the part span {size:.3g} m: compare its size with its drawing"
                )
        return part

    def _positions(self, index: int) -> Float[np.ndarray, "n 3"]:
        """Refuse positions that do not fill the box that is declared of them."""
        accessor, stored = self._tree["accessors"][index], self._rows(index)
        rows = stored.astype(np.float64)
        if accessor["type"] != "VEC3":
            raise InputError(f"accessor {index}: positions are no VEC3")
        # The box of a sparse accessor is often that of its base.
        if len(rows) and {"min", "max"} <= accessor.keys() and "sparse" not in accessor:
            declared = np.array([accessor["min"], accessor["max"]], dtype=np.float64)
            held = np.stack([rows.min(axis=0), rows.max(axis=0)])
            rounding = np.spacing(np.abs(held).max().astype(np.float32))
            out = np.abs(declared - held).max() - rounding
            if out > _TOLERANCE * np.ptp(declared, axis=0).max():
                raise InputError(
                    f"accessor {index} declares positions from {declared[0].tolist()} to "
                    f"{declared[1].tolist()}, but holds {held[0].tolist()} to {held[1].tolist()}; "
                    "the file is damaged"
                )
        if accessor.get("normalized"):
            rows = np.maximum(rows / np.iinfo(stored.dtype).max, -1)
        return rows

    def _rows(self, index: int) -> np.ndarray:
        accessor = self._tree["accessors"][index]
        count, width = accessor["count"], _WIDTHS[accessor["type"]]
        kind, sparse = _TYPES[accessor["componentType"]], accessor.get("sparse")
        if "bufferView" in accessor:
            rows = self._view(accessor, count, width, kind)
        elif sparse:
            check_placed(count)  # the file holds less
            rows = np.zeros((count, width), kind)
        else:
            raise InputError(f"accessor {index} has no data that can be read")
        if sparse:
            named, rows = sparse["indices"], rows.copy()
            where = self._view(named, sparse["count"], 1, _TYPES[named["componentType"]])[:, 0]
            values = self._view(sparse["values"], sparse["count"], width, kind)
            rows[where.astype(np.uint64)] = values
        return rows

    def _view(self, accessor: dict[str, Any], count: int, width: int, kind: str) -> np.ndarray:
        """Return rows of the buffer view that an accessor, or a part of a sparse one, names."""
        view, dtype = self._tree["bufferViews"][accessor["bufferView"]], np.dtype(kind)
        offset, row = accessor.get("byteOffset", 0), width * dtype.itemsize
        stride = view.get("byteStride", row)
        end = offset + stride * (count - 1) + row
        least = min(offset, count, stride - row, view.get("byteOffset", 0))
        if least < 0 or end > view["byteLength"]:  # rows that overlap could fill any memory
            raise InputError(
                f"{count} rows overlap, or reach beyond buffer view {accessor['bufferView']}"
            )
        data, start = self._buffer(view["buffer"]), view.get("byteOffset", 0) + offset
        return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            buffer, data = self._tree["buffers"][index], b"" if index else self._binary
            uri = buffer.get("uri")
            if uri is not None and uri.startswith("data:"):
                head, _, body = uri.partition(",")
                data = unquote_to_bytes(body)
                data = base64.b64decode(data) if head.endswith(";base64") else data
            elif uri is not None:
                with reading(path := self._folder / unquote(uri), "a buffer of glTF"):
                    data = path.read_bytes()
            if len(data) < buffer["byteLength"]:
                raise InputError(f"buffer {index} is cut short: {len(data)} bytes")
            self._buffers[index] = data
        return self._buffers[index]
