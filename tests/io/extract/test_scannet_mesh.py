"""Objects cut from the fused mesh of a room that the tests write themselves."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from qs3.io.extract.scannet import ScanNetSettings, cut_mesh_scene
from qs3.io.extract.scannet_scene import ScanNetScene, read_objects, read_scene_mesh

from ..hostile import refused
from .writers import CHAIR, TABLE, Room, write_aggregation, write_mesh, write_room, write_segments

SETTINGS = ScanNetSettings(min_points=100)
PLY, SEGS = "scene0000_00_vh_clean_2.ply", "scene0000_00_vh_clean_2.0.010000.segs.json"


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    return write_room(tmp_path_factory.mktemp("mesh") / "scans", frames=1)


def scene_of(folder: Path) -> ScanNetScene:
    return ScanNetScene("scene0000_00", folder, "train")


def test_clouds_are_vertices_of_their_objects(room: Room) -> None:
    clouds = list(cut_mesh_scene(scene_of(room.folder), SETTINGS))
    assert [(cloud.id, cloud.class_name, cloud.split) for cloud in clouds] == [
        (f"scene0000_00/{CHAIR}", "chair", "train"),
        (f"scene0000_00/{TABLE}", "table", "train"),
    ]
    for number, cloud in zip((CHAIR, TABLE), clouds, strict=True):
        assert cloud.points.shape == (2048, 3)
        assert len(np.unique(cloud.points, axis=0)) > 1900  # seams have equal vertices
        placed = cloud.points + np.array(cloud.source["origin"])
        assert room.surface(number, placed).max() < 1e-5


def test_convention_z_up_and_not_mirrored(room: Room) -> None:
    """The back is up and towards +y, the one arm towards −x; the released clouds swap y and z."""
    chair = next(cut_mesh_scene(scene_of(room.folder), SETTINGS)).points
    assert chair[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert chair[:, 2].max() == pytest.approx(0.95, abs=0.02)
    np.testing.assert_allclose(chair[:, :2].min(axis=0), -chair[:, :2].max(axis=0), atol=1e-6)
    assert chair[chair[:, 2] > 0.7][:, 1].min() > 0.14
    arm = chair[(chair[:, 2] > 0.45) & (chair[:, 2] < 0.6) & (chair[:, 1] < 0.1)]
    assert len(arm) > 50
    assert arm[:, 0].max() < -0.14


def test_seed_and_number_of_points(room: Room) -> None:
    def chair(seed: int = 0, num_points: int = 2048) -> np.ndarray:
        settings = dataclasses.replace(SETTINGS, seed=seed)
        return next(cut_mesh_scene(scene_of(room.folder), settings, num_points)).points

    np.testing.assert_array_equal(chair(), chair())
    assert chair().tobytes() != chair(seed=1).tobytes()
    whole = chair(num_points=10**6)
    segments = json.loads((room.folder / SEGS).read_text())["segIndices"]
    assert len(whole) == sum(segment < 30 for segment in segments)
    assert list(cut_mesh_scene(scene_of(room.folder), ScanNetSettings(min_points=10**6))) == []


def test_a_shared_segment_goes_to_the_first(tmp_path: Path) -> None:
    vertices = np.arange(12.0).reshape(4, 3)
    write_mesh(tmp_path / PLY, vertices, np.array([[0, 1, 2], [1, 2, 3]]))
    write_segments(tmp_path / SEGS, [7, 7, 8, 9])
    write_aggregation(
        tmp_path / "scene0000_00.aggregation.json",
        [(0, "chair", [7]), (1, "table", [7, 8]), (2, "floor", [9])],
    )
    scene = scene_of(tmp_path)
    placed, owner = read_scene_mesh(scene, read_objects(scene))
    np.testing.assert_array_equal(placed, vertices)
    assert owner.tolist() == [0, 0, 1, -1]


def scene_with(tmp_path: Path, name: str, content: bytes) -> ScanNetScene:
    write_mesh(tmp_path / PLY, np.eye(3), np.array([[0, 1, 2]]))
    write_segments(tmp_path / SEGS, [1, 1, 1])
    write_aggregation(tmp_path / "scene0000_00.aggregation.json", [(0, "chair", [1])])
    (tmp_path / name).write_bytes(content)
    return scene_of(tmp_path)


BAD = {
    "no ply": (PLY, b"solid", "read as PLY"),
    "too few": (SEGS, b'{"segIndices": [1, 1]}', "2 segIndices for 3 vertices"),
    "text": (SEGS, b'{"segIndices": [1, 1, "a"]}', "as a list of segments"),
    "other": (SEGS, b'{"segGroups": []}', "segIndices"),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_files_are_one_line(tmp_path: Path, fault: str) -> None:
    name, content, message = BAD[fault]
    scene = scene_with(tmp_path, name, content)
    with refused(message, tmp_path / name):
        list(cut_mesh_scene(scene, SETTINGS))
