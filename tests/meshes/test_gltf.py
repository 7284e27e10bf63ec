"""glTF as its specification allows it: the right area and size, or a refusal."""

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qs3.meshes import load_mesh

from ..clouds.hostile import refused

SQUARE = np.array([[0, 0, 0], [3, 0, 0], [0, 2, 0], [3, 2, 0]], dtype="<f4")
FLOAT, BYTE, SHORT, INDEX = 5126, 5121, 5122, 5123


class Gltf:
    """A file that is put together array by array."""

    def __init__(self) -> None:
        self.data = b""
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "bufferViews": [],
            "accessors": [],
            "meshes": [],
            "nodes": [],
        }

    def view(self, array: np.ndarray) -> int:
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.tree["bufferViews"].append(view)
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, component: int, **more: Any) -> int:
        kind = "VEC3" if array.ndim == 2 else "SCALAR"
        self.tree["accessors"].append(
            {"bufferView": self.view(array), "componentType": component, "count": len(array)}
            | {"type": kind}
            | more
        )
        return len(self.tree["accessors"]) - 1

    def mesh(self, position: int, indices: int | None = None, mode: int = 4, **more: Any) -> None:
        primitive = {"attributes": {"POSITION": position}, "mode": mode} | more
        if indices is not None:
            primitive["indices"] = indices
        self.tree["meshes"].append({"primitives": [primitive]})
        self.tree["nodes"].append({"mesh": len(self.tree["meshes"]) - 1})

    def write(self, path: Path, uri: str = "", **more: Any) -> Path:
        buffer: dict[str, Any] = {"byteLength": len(self.data)}
        if path.suffix == ".gltf":
            (path.parent / "the data.bin").write_bytes(self.data)
            plain = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
            buffer["uri"] = uri or plain
        nodes = range(len(self.tree["nodes"]))
        tree = {"scenes": [{"nodes": list(nodes)}]} | self.tree | {"buffers": [buffer]} | more
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        if path.suffix == ".glb":
            body = struct.pack("<I4s", len(text), b"JSON") + text
            body += struct.pack("<I4s", len(self.data), b"BIN\0") + self.data
            text = b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body
        path.write_bytes(text)
        return path


def box(array: np.ndarray) -> dict[str, list[float]]:
    return {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}


def square(mode: int, order: list[int]) -> Gltf:
    file = Gltf()
    position = file.accessor(SQUARE, FLOAT, **box(SQUARE))
    file.mesh(position, file.accessor(np.array(order, "<u2"), INDEX), mode)
    return file


def normalised() -> Gltf:
    file, corners = Gltf(), np.array([[0, 0, 0], [255, 0, 0], [0, 255, 0]], "<u1")
    rows = np.pad(corners, ((0, 0), (0, 1)))
    view = file.view(rows)
    file.tree["bufferViews"][view]["byteStride"] = 4
    file.tree["accessors"].append(
        {"bufferView": view, "componentType": BYTE, "count": 3, "type": "VEC3", "normalized": True}
        | box(corners)
    )
    file.mesh(0)
    file.tree["nodes"][0] |= {"scale": [3, 4, 1]}
    file.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    return file


def nested() -> Gltf:
    """Twice the square: mirrored by a matrix, and below a turned, scaled and moved node."""
    file = square(4, [0, 1, 2, 1, 3, 2])
    mirror = np.diag([-1.0, 1, 1, 1]).T.ravel().tolist()
    file.tree["nodes"] = [
        {"mesh": 0, "matrix": mirror},
        {"translation": [0, 0, 9], "rotation": [0, 0, 0.5**0.5, 0.5**0.5], "children": [2]},
        {"mesh": 0, "scale": [2, 1, 1], "camera": 0},
    ]
    file.tree |= {"scene": 1, "scenes": [{"nodes": []}, {"nodes": [0, 1]}]}
    file.tree["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}]
    return file


def sparse(has_base: bool = True) -> Gltf:
    """A square whose upper corners, or of whose four zeros three, lie elsewhere."""
    file = square(4, [0, 1, 2, 1, 3, 2])
    rows, moved = [2, 3], [[0, 5, 0], [3, 5, 0]]
    if not has_base:
        rows, moved = [1, 2], [[5, 0, 0], [0, 5, 0]]
        del file.tree["accessors"][0]["bufferView"]
        file.tree["meshes"][0]["primitives"][0]["indices"] = file.accessor(
            np.array([0, 1, 2], "<u2"), INDEX
        )
    file.tree["accessors"][0]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": file.view(np.array(rows, "<u1")), "componentType": BYTE},
        "values": {"bufferView": file.view(np.array(moved, "<f4"))},
    }
    return file


def hidden() -> Gltf:
    """A square, and below a hidden node two more of which one says that it is visible."""
    file = square(4, [0, 1, 2, 1, 3, 2])
    shown = {"KHR_node_visibility": {"visible": True}}
    file.tree["nodes"][0]["extensions"] = shown
    file.tree["nodes"] += [
        {"children": [2, 3], "extensions": {"KHR_node_visibility": {"visible": False}}},
        {"mesh": 0, "translation": [9, 0, 0]},
        {"mesh": 0, "translation": [0, 9, 0], "extensions": shown},
    ]
    file.tree["scenes"] = [{"nodes": [0, 1]}]
    file.tree["extensionsRequired"] = ["KHR_node_visibility"]
    return file


def coarser() -> Gltf:
    """A square that has a coarser one in its place from afar, in a file without a scene."""
    file = square(4, [0, 1, 2, 1, 3, 2])
    file.tree["nodes"][0]["extensions"] = {"MSFT_lod": {"ids": [1]}}
    file.tree["nodes"] += [{"mesh": 0, "scale": [2, 2, 1]}]
    file.tree["scenes"] = []
    return file


READ = {
    "normalised": (normalised(), 6, (3, 4, 0)),
    "triangles": (square(4, [0, 1, 2, 1, 3, 2]), 6, (3, 2, 0)),
    "nested": (nested(), 18, (3, 6, 9)),
    "strip": (square(5, [0, 1, 2, 3]), 6, (3, 2, 0)),
    "fan": (square(6, [0, 1, 3, 2]), 6, (3, 2, 0)),
    "sparse": (sparse(), 15, (3, 5, 0)),
    "sparse alone": (sparse(has_base=False), 12.5, (5, 5, 0)),
    "hidden": (hidden(), 6, (3, 2, 0)),
    "coarser": (coarser(), 6, (3, 2, 0)),
}


@pytest.mark.parametrize("ending", ["glb", "gltf"])
@pytest.mark.parametrize("name", READ)
def test_valid_gltf_has_its_area_and_size(tmp_path: Path, name: str, ending: str) -> None:
    file, area, size = READ[name]
    mesh = load_mesh(file.write(tmp_path / f"a.{ending}"), up="z")
    assert mesh.area == pytest.approx(area, rel=1e-6)
    np.testing.assert_allclose(mesh.extents, size, atol=1e-6)
    assert (mesh.face_normals[:, 2] > 0).all()  # a mirrored node does not turn it inside out


def test_names_of_buffers_are_percent_encoded(tmp_path: Path) -> None:
    path = square(4, [0, 1, 2]).write(tmp_path / "a.gltf", "the%20data.bin")
    assert load_mesh(path).area == pytest.approx(3)


def square_with(place: str, more: dict[str, Any], nodes: list[Any] | None = None) -> Gltf:
    """A square with more keys in the first node, mesh or accessor, or with more nodes."""
    file = square(4, [0, 1, 2])
    file.tree[place][0] |= more
    file.tree["nodes"] += nodes or []
    return file


def outside() -> Gltf:
    """The first part names a vertex of the second."""
    file = square(4, [0, 1, 5])
    file.mesh(file.accessor(SQUARE[:3] + 9, FLOAT))
    return file


def without_data() -> Gltf:
    file = square(4, [0, 1, 2])
    del file.tree["accessors"][0]["bufferView"]
    return file


def far_sparse() -> Gltf:
    file = sparse()
    file.tree["accessors"][0]["sparse"]["indices"]["bufferView"] = file.view(
        np.array([2, 9], "<u1")
    )
    return file


def vast_sparse() -> Gltf:
    file = sparse(has_base=False)
    file.tree["accessors"][0]["count"] = 10**12
    return file


def float_indices() -> Gltf:
    file = Gltf()
    file.mesh(file.accessor(SQUARE, FLOAT), file.accessor(np.arange(3, dtype="<f4"), FLOAT))
    return file


PERSPECTIVE = {"matrix": [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
LOOP = [{"children": [2]}, {"children": [1]}]
INSTANCED = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}}
REQUIRED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "EXT_mesh_gpu_instancing")
REFUSED = {
    **{name: (square(4, [0, 1, 2]), {"extensionsRequired": [name]}, name) for name in REQUIRED},
    "instanced": (square_with("nodes", INSTANCED), {}, "EXT_mesh_gpu_instancing"),
    "version 1": (square(4, [0, 1, 2]), {"asset": {"version": "1.0"}}, r"glTF 1\.0"),
    "version 3": (square(4, [0, 1, 2]), {"asset": {"version": "3.0"}}, r"glTF 3\.0"),
    "loop": (square_with("nodes", {}, LOOP), {}, "two parents, or is below itself"),
    "backwards": (square_with("nodes", {"mesh": -1}), {}, "item -1"),
    "outside": (outside(), {}, "outside the range"),
    "mode": (square(7, [0, 1, 2]), {}, "mode 7"),
    "perspective": (square_with("nodes", PERSPECTIVE), {}, "matrix ends in"),
    "float indices": (float_indices(), {}, "no whole numbers"),
    "skin": (square_with("nodes", {"skin": 0}), {}, "skin"),
    "morphed": (square_with("meshes", {"weights": [0, 0.5]}), {}, "morphed shape"),
    "no data": (without_data(), {}, "accessor 0 has no data"),
    "sparse and far": (far_sparse(), {}, "out of bounds"),
    "sparse and vast": (vast_sparse(), {}, "when all parts are placed"),
    "overlap": (square_with("bufferViews", {"byteStride": 0}), {}, "rows overlap"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_gltf_that_is_not_read_is_refused_by_name(tmp_path: Path, name: str) -> None:
    file, more, message = REFUSED[name]
    path = file.write(tmp_path / "a.glb", **more)
    with refused(message, path):
        load_mesh(path)


@pytest.mark.parametrize("key", ["min", "max"])
@pytest.mark.parametrize("value", [[1, 1, 0], [0.1, 0, 0], [-9, 0, 0]])
def test_positions_have_to_fill_their_declared_box(tmp_path: Path, key: str, value: Any) -> None:
    file = square(4, [0, 1, 2, 1, 3, 2])
    file.tree["accessors"][0][key] = value
    with refused("accessor 0 declares positions from"):
        load_mesh(file.write(tmp_path / "a.glb"))


def test_data_cut_short_or_missing_is_refused(tmp_path: Path) -> None:
    file = square(4, [0, 1, 2])
    path = file.write(tmp_path / "a.glb")
    first = b'glTF\1\0\0\0\x28\0\0\0\x14\0\0\0\0\0\0\0{"nodes":{"a":{}}}  '
    (tmp_path / "old.glb").write_bytes(first)
    with refused("is binary glTF 1; only 2 is read", tmp_path / "old.glb"):
        load_mesh(tmp_path / "old.glb")
    path.write_bytes(path.read_bytes()[:-4])
    with refused("cut short", path):
        load_mesh(path)
    path = file.write(tmp_path / "b.gltf", "the%20data.bin")
    (tmp_path / "the data.bin").write_bytes(file.data[:20])
    with refused("cut short", path):
        load_mesh(path)
    file.tree["accessors"][0]["count"] = 5
    with refused("beyond buffer view"):
        load_mesh(file.write(tmp_path / "c.glb"))


def test_vertices_that_are_placed_too_often_are_refused(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("qs3.meshes.polygons._MOST", 9)
    file = square_with("nodes", {}, [{"mesh": 0}] * 2)  # 4 vertices thrice, 1 triangle each
    with refused("12 triangles or vertices when all parts"):
        load_mesh(file.write(tmp_path / "a.glb"))
