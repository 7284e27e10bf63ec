"""Objects cut from the raw depth frames of a room that the tests render themselves."""

import dataclasses
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from qs3.errors import InputError
from qs3.io.extract.run import ExtractedCloud, OutputSettings
from qs3.io.extract.scannet import ScanNetSettings, extract_scannet
from qs3.io.extract.scannet_frames import cut_scene, erode, read_mask
from qs3.io.extract.scannet_scene import (
    ScanNetScene,
    axis_alignment,
    class_of,
    list_scenes,
    read_objects,
    read_splits,
)
from qs3.io.layouts.store import read_ragged
from qs3.store.manifest import open_dataset

from ..hostile import refused
from .writers import (
    CHAIR,
    LOST,
    ROOM,
    TABLE,
    Room,
    png,
    render,
    write_aggregation,
    write_masks,
    write_room,
)

SETTINGS = ScanNetSettings(every=1, min_pixels=30, min_points=100)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    """A tilted room, the colour camera 3 cm beside the depth camera."""
    return write_room(tmp_path_factory.mktemp("room") / "scans", apart=0.03)


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
    """Depth is stored in millimetres, so that half of one is all that may be missing."""
    clouds = extract(room, cut="masks")
    assert {number: cloud.class_name for number, cloud in clouds.items()} == {
        CHAIR: "chair",
        TABLE: "table",
    }
    for number, cloud in clouds.items():
        assert cloud.points.dtype == np.float32
        assert cloud.id == f"scene0000_00/{number}"
        points = in_room(cloud)
        assert room.surface(number, points).max() < 1e-3
        low, high = room.box(number)
        np.testing.assert_allclose(points.max(axis=0), high, atol=0.005)
        np.testing.assert_allclose(points.min(axis=0)[:2], low[:2], atol=0.005)
        assert points[:, 2].min() < 0.05  # erosion takes the edge with the floor
        assert points[:, 2].min() > low[2] - 0.001


def test_clouds_by_the_mesh_lie_on_their_objects(room: Room) -> None:
    """The floor's vertices claim the floor's points, but for a rim of half their spacing."""
    for number, cloud in extract(room, cut="mesh").items():
        away = room.surface(number, in_room(cloud))
        assert np.quantile(away, 0.95) < 1e-3
        assert away.max() < 0.015


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
    straight = write_room(tmp_path / "scans", tilt=False, apart=0.03)
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


def test_frames_and_points_are_bounded(room: Room) -> None:
    few = extract(room, max_frames=3, max_points=700)
    for cloud in few.values():
        assert cloud.source["frames"] == 3
        assert cloud.source["frames_seen"] == 12
        assert len(cloud.points) == 700
        assert cloud.source["measured"] > 700
    assert extract(room, max_frames=0)[CHAIR].source["frames"] == 12


def test_masks_of_the_depth_image_are_taken_pixel_by_pixel(tmp_path: Path) -> None:
    room = write_room(tmp_path / "scans", frames=4)
    sens = room.sens
    masks = {
        index: render(ROOM, sens.depth_intrinsic, sens.depth_size, room.align @ pose)[1]
        for index, pose in enumerate(sens.poses)
    }
    write_masks(room.folder / "scene0000_00_2d-instance-filt.zip", masks)
    for number, cloud in extract(room, erode=0, voxel=1e-3, max_points=10**6).items():
        points = in_room(cloud)
        assert room.surface(number, points).max() < 1e-3
        seen = sum(int((mask == number + 1).sum()) for mask in masks.values())
        assert cloud.source["measured"] == seen


def test_hidden_points_are_left_out(tmp_path: Path) -> None:
    """A colour camera 20 cm aside sees past the chair; what it cannot see is not cut out."""
    room = write_room(tmp_path / "scans", apart=0.2)
    for number, cloud in extract(room).items():
        assert room.surface(number, in_room(cloud)).max() < 1e-3


def test_frames_without_pose_or_mask_are_passed_over(tmp_path: Path) -> None:
    room = write_room(tmp_path / "scans", frames=8)
    room.sens.poses = [LOST, *list(room.sens.poses)[1:]]
    room.sens.write(room.folder / "scene0000_00.sens")
    path = room.folder / "scene0000_00_2d-instance-filt.zip"
    write_masks(path, {index: mask for index, mask in room.masks.items() if index != 3})
    clouds = list(cut_scene(scene_of(room, "test"), SETTINGS))
    assert [cloud.source["frames"] for cloud in clouds] == [6, 6]
    assert {cloud.split for cloud in clouds} == {"test"}
    for none in ({"classes": ("bed",)}, {"min_points": 10**6}):
        assert list(cut_scene(scene_of(room), dataclasses.replace(SETTINGS, **none))) == []


@pytest.mark.parametrize("from_mesh", [False, True])
def test_both_ways_give_the_rooms_objects_with_their_split(room, tmp_path, from_mesh):
    (tmp_path / "train.txt").write_text("scene0000_00\n")
    settings = dataclasses.replace(
        SETTINGS, from_mesh=from_mesh, splits_train=tmp_path / "train.txt"
    )
    output = OutputSettings(str(tmp_path / "out"), num_points=256, workers=0)
    report = extract_scannet(room.folder.parent, output, settings)
    assert (report.objects, report.units, report.failed) == (2, 1, 0)
    clouds = read_ragged(tmp_path / "out")
    assert {clouds.class_names[label] for label in clouds.labels} == {"chair", "table"}
    assert set(clouds.splits) == {"train"}
    assert {len(cloud) for cloud in clouds.clouds} == {256}
    stored = open_dataset(tmp_path / "out").settings
    assert stored["from_mesh"] is from_mesh
    assert str(tmp_path) not in str(stored)
    assert extract_scannet(room.folder.parent, output, settings).skipped == 1


def test_a_scene_without_masks_or_mesh_says_so(tmp_path: Path) -> None:
    room = write_room(tmp_path / "scans", frames=2, mesh=False, masks=False)
    with pytest.raises(InputError, match=r"neither .*instance-filt.zip nor .*_vh_clean_2.ply"):
        extract(room)
    with pytest.raises(InputError, match=r"instance-filt.zip"):
        extract(room, cut="masks")


def test_a_cut_file_yields_no_object(room: Room, tmp_path: Path) -> None:
    content = (room.folder / "scene0000_00.sens").read_bytes()
    other = tmp_path / "scene0000_00"
    other.mkdir()
    for path in room.folder.iterdir():
        (other / path.name).write_bytes(path.read_bytes())
    (other / "scene0000_00.sens").write_bytes(content[: len(content) * 3 // 4])
    with pytest.raises(InputError, match=r"cut off|does not unpack"):
        next(cut_scene(ScanNetScene("scene0000_00", other), SETTINGS))


# Masks.


def mask_of(path: Path, frame: int) -> np.ndarray | None:
    with zipfile.ZipFile(path) as archive:
        return read_mask(archive, frame, ((64, 48), (32, 24)))


def test_masks_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    large, little = (rng.integers(0, 200, size, dtype=np.uint8) for size in ((48, 64), (24, 32)))
    path = write_masks(tmp_path / "a.zip", {0: large, 100: little})
    np.testing.assert_array_equal(mask_of(path, 0), large)
    np.testing.assert_array_equal(mask_of(path, 100), little)
    assert mask_of(path, 1) is None


BAD_MASKS = {
    "another size": (png(np.zeros((1000, 2000), np.uint8)), "expected 8 bits, 64×48 or 32×24"),
    "no png": (b"GIF89a" + bytes(40), "not a PNG"),
    "cut": (png(np.zeros((48, 64), np.uint8))[:24], "cut off|damaged"),
    "16 bits": (png(np.zeros((48, 64), np.uint16)), "8 bits"),
    "colour": (png(np.zeros((48, 64, 3), np.uint8)), "8 bits"),
    "bomb": (bytes(50 * 2**20), "unpack"),
}


@pytest.mark.parametrize("fault", BAD_MASKS)
def test_a_bad_mask_is_one_line(tmp_path: Path, fault: str) -> None:
    content, message = BAD_MASKS[fault]
    path = write_masks(tmp_path / "a.zip", {7: content})
    with refused(message, "a.zip: instance-filt/7.png"):
        mask_of(path, 7)


def test_erosion_keeps_what_is_alone_within_reach() -> None:
    mask = np.zeros((12, 14), np.uint8)
    mask[:6], mask[6:] = 3, 5
    mask[2, 4] = 0
    expected = mask.copy()
    for row in range(12):
        for column in range(14):
            window = mask[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
            if len(np.unique(window)) > 1:
                expected[row, column] = 0
    np.testing.assert_array_equal(erode(mask, 2), expected)
    np.testing.assert_array_equal(erode(mask, 0), mask)


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
        assert [(s.id, s.split) for s in scenes] == [
            ("scene0000_01", "test"),
            ("scene0001_00", "train"),
        ]
    assert [s.id for s in list_scenes(tmp_path, ["scene0001_00"])] == ["scene0001_00"]
    assert [s.id for s in list_scenes(tmp_path, splits={"scene0001_00": "train"})] == [
        "scene0001_00"
    ]
    place = list_scenes(tmp_path / "scans" / "scene0001_00")
    assert [s.id for s in place] == ["scene0001_00"]
    assert pickle.loads(pickle.dumps(place)) == place  # noqa: S301


def test_wrong_scenes_and_splits_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "scene0000_00").mkdir()
    for root, names, message in (
        (tmp_path / "none", None, "no folder of the form"),
        (tmp_path, ["scene0005_00"], "has no scene"),
        (tmp_path, ["../etc"], "has no scene"),
        (tmp_path, [], "none of the scenes"),
    ):
        with pytest.raises(InputError, match=message):
            list_scenes(root, names)
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
    for label, name in {
        "Office  Chair": "chair",
        "kitchen cabinets": "cabinet",
        "tv": "monitor",
        "coffee table": "table",
        "couch": "sofa",
        "shelf": "bookshelf",
        "nightstand": "cabinet",
        "sofa chair": "chair",
        "potted plant": "plant",
        "toilet": None,
        "": None,
        "tv stand": None,
        "bed sheet": None,
    }.items():
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


@pytest.mark.parametrize(
    "content",
    [
        b"[",
        b'{"segGroups": 3}',
        b'{"segGroups": [{"objectId": 0, "label": "chair"}]}',
        b'{"segGroups": [{"objectId": 1, "label": 5, "segments": []}]}',
    ],
)
def test_a_bad_aggregation_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s.aggregation.json"
    path.write_bytes(content)
    with refused(".", path):
        read_objects(ScanNetScene("s", tmp_path))


@pytest.mark.parametrize(
    "value",
    ["", "1 2 3", "x " * 16, "0 " * 16, "nan " * 16, "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"],
)
def test_a_bad_alignment_is_one_line(tmp_path: Path, value: str) -> None:
    (tmp_path / "s.txt").write_text(f"colorHeight = 968\naxisAlignment = {value}\n")
    with pytest.raises(InputError, match="axisAlignment"):
        axis_alignment(ScanNetScene("s", tmp_path))


@pytest.mark.parametrize(
    ("name", "value"),
    [("every", 0), ("near", 4.0), ("far", np.nan), ("voxel", 0.0), ("distance", -1.0),
     ("classes", ()), ("seed", -1)],
)  # fmt: skip
def test_settings_out_of_range_are_refused(name: str, value: object) -> None:
    with pytest.raises(InputError, match=name):
        ScanNetSettings(**{name: value})
