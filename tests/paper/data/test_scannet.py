"""Objects cut from the raw depth frames of a room that the tests render themselves."""

import dataclasses
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from qs3.clouds.layouts.store import read_ragged
from qs3.errors import InputError
from qs3.objects.run import ExtractedCloud, OutputSettings
from qs3.paper.data.scannet import ScanNetSettings, _Fusion, cut_scene, extract_scannet
from qs3.paper.data.scannet_scene import (
    ScanNetScene,
    axis_alignment,
    class_of,
    list_scenes,
    read_objects,
    read_scene_mesh,
    read_splits,
)
from qs3.store.manifest import open_dataset

from ...clouds.hostile import refused
from .writers import (
    CHAIR,
    LOST,
    TABLE,
    Room,
    write_aggregation,
    write_mesh,
    write_room,
    write_segments,
)

SETTINGS = ScanNetSettings(every=1, min_pixels=30, min_points=100)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    """A room whose own frame is tilted."""
    return write_room(tmp_path_factory.mktemp("room") / "scans")


def scene_of(room: Room, split: str = "") -> ScanNetScene:
    return ScanNetScene(room.folder.name, room.folder, split)


def extract(room: Room, **changes: object) -> dict[int, ExtractedCloud]:
    settings = dataclasses.replace(SETTINGS, **changes)
    clouds = cut_scene(scene_of(room), settings)
    return {int(cloud.id.rpartition("/")[2]): cloud for cloud in clouds}


def on_top(room: Room, number: int, points: np.ndarray) -> np.ndarray:
    """Heights over an object's top of the points [n 3] within 3 cm of it, rim aside."""
    low, high = room.box(number)
    inside = ((points > low + 0.02) & (points < high - 0.02))[:, :2].all(axis=1)
    height = points[inside, 2] - high[2]
    return height[np.abs(height) < 0.03]


def in_room(cloud: ExtractedCloud) -> np.ndarray:
    return cloud.points + np.array(cloud.source["origin"])


def test_clouds_lie_on_their_objects(room: Room) -> None:
    """The floor's vertices claim the floor's points, but for a rim of half their spacing."""
    clouds = extract(room)
    assert {n: cloud.class_name for n, cloud in clouds.items()} == {CHAIR: "chair", TABLE: "table"}
    for number, cloud in clouds.items():
        assert cloud.points.dtype == np.float32
        assert cloud.id == f"scene0000_00/{number}"
        points = in_room(cloud)
        away = room.surface(number, points)
        assert np.quantile(away, 0.95) < 1e-3  # depth is stored in millimetres
        assert away.max() < 0.015
        low, high = room.box(number)
        np.testing.assert_allclose(points.max(axis=0)[2], high[2], atol=0.005)
        np.testing.assert_allclose(points.max(axis=0), high, atol=0.015)
        np.testing.assert_allclose(points.min(axis=0), low, atol=0.015)


def test_convention_not_mirrored(room: Room) -> None:
    """A chair with one arm fits its own surface; its mirror images do not."""
    points = in_room(extract(room)[CHAIR])
    low, high = room.box(CHAIR)
    for axis in range(2):
        mirrored = points.copy()
        mirrored[:, axis] = low[axis] + high[axis] - mirrored[:, axis]
        assert np.quantile(room.surface(CHAIR, mirrored), 0.95) > 0.05


def test_convention_z_is_up_after_alignment(tmp_path: Path, room: Room) -> None:
    """The back of the chair is up and behind, and the cloud stands over the origin."""
    straight = write_room(tmp_path / "scans", tilt=False)
    for place in (room, straight):
        points = extract(place)[CHAIR].points
        np.testing.assert_allclose(points.min(axis=0)[2], 0.0, atol=1e-6)
        np.testing.assert_allclose(points[:, :2].min(axis=0), -points[:, :2].max(axis=0), atol=1e-5)
        assert 0.88 < points[:, 2].max() < 0.96
        assert (points[points[:, 2] > 0.75][:, 1] > 0.1).all()
    # Without the .txt file the scene's own frame stays as it is, which is tilted here.
    (room.folder / "scene0000_00.txt").rename(room.folder / "kept.txt")
    try:
        tilted = extract(room)[CHAIR].points
    finally:
        (room.folder / "kept.txt").rename(room.folder / "scene0000_00.txt")
    assert not 0.88 < np.ptp(tilted[:, 2]) < 0.96


def test_every_point_is_one_the_sensor_measured(tmp_path: Path) -> None:
    """Noise of 1 cm comes out whole: the cloud is a part of the raw points, and as rough."""
    room = write_room(tmp_path / "scans", noise=0.01)
    tree = KDTree(room.measured())
    for number, cloud in extract(room).items():
        points = in_room(cloud)
        assert tree.query(points)[0].max() < 2e-6
        kept, raw = on_top(room, number, points), on_top(room, number, room.measured())
        assert len(kept) > 300
        assert kept.std() > 0.95 * raw.std() > 0.004


def test_the_same_twice_and_another_seed_differs(room: Room) -> None:
    first, again, other = extract(room), extract(room), extract(room, seed=1)
    np.testing.assert_array_equal(first[CHAIR].points, again[CHAIR].points)
    assert first[CHAIR].source == again[CHAIR].source
    assert first[CHAIR].points.tobytes() != other[CHAIR].points.tobytes()


def test_frames_are_bounded_and_chosen_uniformly(room: Room) -> None:
    for cloud in extract(room, max_frames=3).values():
        assert cloud.source["frames"] == 3
        assert cloud.source["frames_seen"] == 12
    seen = np.zeros(10)
    for seed in range(250):
        fusion = _Fusion(2, np.random.default_rng(seed))
        for frame in range(10):
            fusion.add(np.full((1, 3), frame, dtype=np.float32))
        seen[fusion.cloud(0.01)[:, 0].astype(int)] += 1
    assert ((seen - 50) ** 2 / 50).sum() < 27.9  # passes 999 of 1000 uniform draws


def test_each_voxel_keeps_one_of_its_points_with_equal_chance(rng: np.random.Generator) -> None:
    points = rng.uniform(-0.1, 0.1, (2000, 3)).astype(np.float32)
    fusion = _Fusion(1, rng)
    fusion.add(points)
    kept = fusion.cloud(0.02)
    assert {*map(tuple, kept.tolist())} <= {*map(tuple, points.tolist())}
    for cloud in (kept, points):
        cells = np.floor((cloud - points.min(axis=0)) / 0.02)
        assert len(np.unique(cells, axis=0)) == len(kept)
    fusion = _Fusion(1, rng)
    fusion.add(np.linspace(0.001, 0.009, 24).reshape(8, 3).astype(np.float32))
    counts = np.unique([fusion.cloud(1.0)[0, 0] for _ in range(1600)], return_counts=True)[1]
    assert ((counts - 200) ** 2 / 200).sum() < 24.3


def test_frames_without_pose_are_skipped(tmp_path: Path) -> None:
    room = write_room(tmp_path / "scans", frames=8)
    room.sens.poses = [LOST, *list(room.sens.poses)[1:]]
    room.sens.write(room.folder / "scene0000_00.sens")
    clouds = list(cut_scene(scene_of(room, "test"), SETTINGS))
    assert [cloud.source["frames"] for cloud in clouds] == [7, 7]
    assert {cloud.split for cloud in clouds} == {"test"}
    for none in ({"classes": ("bed",)}, {"min_points": 10**6}):
        assert list(cut_scene(scene_of(room), dataclasses.replace(SETTINGS, **none))) == []


def test_a_data_set_has_the_rooms_objects_with_their_split(room: Room, tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_text("scene0000_00\n")
    settings = dataclasses.replace(SETTINGS, splits_train=tmp_path / "train.txt")
    output = OutputSettings(str(tmp_path / "out"), num_points=256, workers=0)
    report = extract_scannet(room.folder.parent, output, settings)
    assert (report.objects, report.units, report.failed) == (2, 1, 0)
    clouds = read_ragged(tmp_path / "out")
    assert {clouds.class_names[label] for label in clouds.labels} == {"chair", "table"}
    assert set(clouds.splits) == {"train"}
    assert {len(cloud) for cloud in clouds.clouds} == {256}
    assert str(tmp_path) not in str(open_dataset(tmp_path / "out").settings)
    assert extract_scannet(room.folder.parent, output, settings).skipped == 1


# Scenes.


def test_scenes_and_splits(tmp_path: Path) -> None:
    for name in ("scene0001_00", "scene0000_01", "notes", "scene12"):
        (tmp_path / "scans" / name).mkdir(parents=True)
    (tmp_path / "train.txt").write_text("scene0001_00\nscene0009_00\n\n")
    (tmp_path / "val.txt").write_text("scene0000_01\r\n")
    splits = read_splits(tmp_path / "train.txt", tmp_path / "val.txt")
    assert splits == {"scene0001_00": "train", "scene0009_00": "train", "scene0000_01": "test"}
    for root in (tmp_path, tmp_path / "scans"):
        scenes = list_scenes(root, splits=splits)
        assert {s.id: s.split for s in scenes} == {"scene0000_01": "test", "scene0001_00": "train"}
    place = list_scenes(tmp_path / "scans" / "scene0001_00")
    for listed in (place, list_scenes(tmp_path, splits={"scene0001_00": "train"})):
        assert [s.id for s in listed] == ["scene0001_00"]
    assert pickle.loads(pickle.dumps(place)) == place  # noqa: S301


def test_wrong_scenes_and_splits_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "scene0000_00").mkdir()
    for root, splits, message in (
        (tmp_path / "none", None, "no folder of the form"),
        (tmp_path, {"scene0005_00": "train"}, "no scene of the lists"),
    ):
        with pytest.raises(InputError, match=message):
            list_scenes(root, splits)
    list_file = tmp_path / "list.txt"
    for content, message in (
        (b"scene0000_00\n../../etc/passwd\n", "is not the name of a scene"),
        (b"\xff\xfe", "cannot be read as a list"),
    ):
        list_file.write_bytes(content)
        with pytest.raises(InputError, match=message):
            read_splits(list_file)
    list_file.write_text("scene0000_00")
    with pytest.raises(InputError, match="other split"):
        read_splits(list_file, list_file)


def test_labels() -> None:
    known = {"Office  Chair": "chair", "kitchen cabinets": "cabinet", "tv": "monitor"}
    known |= {"coffee table": "table", "nightstand": "cabinet", "sofa chair": "chair"}
    for label, name in (known | dict.fromkeys(("toilet", "", "tv stand", "bed sheet"))).items():
        assert class_of(label) == name, label
    assert class_of("toilet", ("bed", "toilet")) == "toilet"


def test_objects_listed_twice_come_once(tmp_path: Path) -> None:
    scene = ScanNetScene("scene0217_00", tmp_path)
    groups = [(1, "chair", [1]), (0, "desk", [2]), (1, "couch", [3]), (4, "wall", [4])]
    write_aggregation(tmp_path / "scene0217_00.aggregation.json", groups)
    objects = read_objects(scene)
    assert [(item.objectId, name, item.segments) for item, name in objects] == [
        (0, "table", (2,)),
        (1, "chair", (1,)),
    ]


def test_bad_aggregations_and_alignments_are_one_line(tmp_path: Path) -> None:
    path, scene = tmp_path / "s.aggregation.json", ScanNetScene("s", tmp_path)
    lacking, wrong = {"objectId": 0, "label": "chair"}, {"objectId": 1, "label": 5, "segments": []}
    for content in ([], {"segGroups": 3}, {"segGroups": [lacking]}, {"segGroups": [wrong]}):
        path.write_text(json.dumps(content))
        with refused(".", path):
            read_objects(scene)
    for value in ("", "1 2 3", "0 " * 16, "nan " * 16, "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"):
        (tmp_path / "s.txt").write_text(f"colorHeight = 968\naxisAlignment = {value}\n")
        with pytest.raises(InputError, match="axisAlignment"):
            axis_alignment(scene)


# Meshes.

PLY, SEGS = "scene0000_00_vh_clean_2.ply", "scene0000_00_vh_clean_2.0.010000.segs.json"


def test_a_shared_segment_goes_to_the_first(tmp_path: Path) -> None:
    vertices = np.arange(12.0).reshape(4, 3)
    write_mesh(tmp_path / PLY, vertices, np.array([[0, 1, 2], [1, 2, 3]]))
    write_segments(tmp_path / SEGS, [7, 7, 8, 9])
    write_aggregation(
        tmp_path / "scene0000_00.aggregation.json",
        [(0, "chair", [7]), (1, "table", [7, 8]), (2, "floor", [9])],
    )
    scene = ScanNetScene("scene0000_00", tmp_path)
    placed, owner = read_scene_mesh(scene, read_objects(scene))
    np.testing.assert_array_equal(placed, vertices)
    assert owner.tolist() == [0, 0, 1, -1]


def scene_with(tmp_path: Path, name: str, content: bytes) -> ScanNetScene:
    write_mesh(tmp_path / PLY, np.eye(3), np.array([[0, 1, 2]]))
    write_segments(tmp_path / SEGS, [1, 1, 1])
    write_aggregation(tmp_path / "scene0000_00.aggregation.json", [(0, "chair", [1])])
    (tmp_path / name).write_bytes(content)
    return ScanNetScene("scene0000_00", tmp_path)


BAD_MESHES = {
    "no ply": (PLY, b"solid", "read as PLY"),
    "too few": (SEGS, b'{"segIndices": [1, 1]}', "2 segIndices for 3 vertices"),
    "text": (SEGS, b'{"segIndices": [1, 1, "a"]}', "as a list of segments"),
    "other": (SEGS, b'{"segGroups": []}', "segIndices"),
}


@pytest.mark.parametrize("fault", BAD_MESHES)
def test_bad_files_of_a_mesh_are_one_line(tmp_path: Path, fault: str) -> None:
    name, content, message = BAD_MESHES[fault]
    scene = scene_with(tmp_path, name, content)
    with refused(message, tmp_path / name):
        read_scene_mesh(scene, read_objects(scene))
