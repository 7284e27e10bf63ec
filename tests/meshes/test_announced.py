"""Small files that announce much are refused before anything is taken for them."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.meshes import load_mesh
from qs3.meshes.announced import memory_limit

from ..io.hostile import refused

TRIANGLE = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


def glb(path: Path, tree: dict | bytes, data: bytes = TRIANGLE) -> Path:
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text
    body += struct.pack("<II", len(data), 0x004E4942) + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def tree(nodes: int = 1, vertices: int = 3, **accessor: int) -> dict:
    """A scene of one mesh, placed by some nodes; with a second accessor its corners."""
    places = {"componentType": 5126, "type": "VEC3", "count": vertices, "bufferView": 0}
    corners = {"componentType": 5125, "type": "SCALAR"} | accessor
    mesh = {"attributes": {"POSITION": 0}} | ({"indices": 1} if accessor else {})
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 12 * vertices}],
        "bufferViews": [{"buffer": 0, "byteLength": 12 * vertices}],
        "accessors": [places, corners] if accessor else [places],
        "meshes": [{"primitives": [mesh]}],
        "nodes": [{"mesh": 0}] * nodes,
        "scenes": [{"nodes": list(range(nodes))}],
        "scene": 0,
    }


def test_a_mesh_placed_thrice_is_read(tmp_path: Path) -> None:
    assert len(load_mesh(glb(tmp_path / "a.glb", tree(nodes=3))).faces) == 3


def test_what_announces_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    zeros = tree()
    zeros["accessors"][0] = {"componentType": 5126, "type": "VEC3", "count": 500_000_000}
    odd = tree()
    odd["accessors"][0]["count"] = 1e12
    cloud = np.zeros((3000, 3), np.float32).tobytes()
    many = tree(nodes=20_000, vertices=3000)
    for content, data, message in (
        (zeros, TRIANGLE, "announces 6000000000 bytes"),
        (tree(count=500_000_000), TRIANGLE, "announces 2000000036 bytes"),
        (many, cloud, "20000 instances of its meshes come to 60003000 vertices"),
        (odd, TRIANGLE, "is no count"),
        (b"[" * 100_000, TRIANGLE, "nested too deep"),
        (b'{"nodes": [' + b"9" * 5000 + b"]}", TRIANGLE, "not a JSON file"),
        (b'{"meshes": [{"primitives": [{"indices": 7}]}]}', TRIANGLE, "damaged"),
    ):
        path = glb(tmp_path / "a.glb", content, data)
        with refused(f"^{path}: .*{message}"):
            load_mesh(path)


def test_reading_takes_so_much_memory_and_no_more(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    path = tmp_path / "a.off"
    path.touch()
    with pytest.raises(InputError, match=r"a\.off: takes over 2\.0 GiB"), memory_limit(path):
        np.empty(2**32, np.uint8)
    assert resource.getrlimit(resource.RLIMIT_AS) == before
