"""A table with boxes of known size: how many are found, how large, how they lie."""

import dataclasses
import json

import numpy as np
import pandas as pd
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from qs3.clouds.files import read_cloud
from qs3.errors import TOLD, InputError
from qs3.objects.cut import turn, upright
from qs3.objects.scene_files import SceneSettings, read_scene, seen_table, segment_scene
from qs3.objects.segment import SegmentSettings, Table, find_table, require_surface, segment
from qs3.points.planes import Plane, fit_plane, refit

from ..clouds.hostile import refused
from .depth_scene import box, looking_down, millimetres, photograph, write_png

UP = np.array([0.0, 0.0, 1.0])
# Length, width, height, then x, y and heading on the table.
BOXES = np.array([
    [0.24, 0.10, 0.20, -0.30, 0.05, 30.0],
    [0.15, 0.12, 0.08, 0.10, -0.15, 100.0],
    [0.10, 0.05, 0.30, 0.35, 0.15, 0.0],
])  # fmt: skip


def surface(size, low, count, rng):
    """Points on the faces of a box, but that below."""
    x, y, z = size
    areas = np.array([x * y, y * z, y * z, x * z, x * z])
    faces = rng.choice(5, count, p=areas / areas.sum())
    points = rng.random((count, 3))
    for face, (axis, side) in enumerate([(2, 1), (0, 0), (0, 1), (1, 0), (1, 1)]):
        points[faces == face, axis] = side
    return points * size + low


def table_scene(rng, noise=0.001):
    """A table of 1.2 × 0.8 m, three boxes on it, the floor below and a wall behind."""
    parts = [np.c_[rng.random((40_000, 2)) * [1.2, 0.8] - [0.6, 0.4], np.zeros(40_000)]]
    for length, width, height, x, y, heading in BOXES:
        points = surface((length, width, height), (-length / 2, -width / 2, 0), 8000, rng)
        turn = Rotation.from_euler("z", heading, degrees=True)
        parts.append(turn.apply(points) + np.array([x, y, 0.0]))
    parts.append(np.c_[rng.random((8000, 2)) * 2 - 1, np.full(8000, -0.7)])
    parts.append(np.c_[rng.random(8000) * 2 - 1, np.full(8000, 0.9), rng.random(8000) * 2 - 0.7])
    scene = np.concatenate(parts)
    return scene + rng.normal(scale=noise, size=scene.shape)


def check(objects, shift=0.0):
    """The three boxes, each within a centimetre and three degrees."""
    assert len(objects) == len(BOXES)
    for length, width, height, x, y, heading in BOXES:
        found = min(objects, key=lambda o: np.hypot(o.centre[0] - x, o.centre[1] - y))
        np.testing.assert_allclose(found.size, (length, width, height), atol=0.01)
        np.testing.assert_allclose(found.centre, (x, y, height / 2), atol=0.01)
        off = abs(found.heading - heading) % 180
        assert min(off, 180 - off) < 3
        assert found.points.dtype == np.float32
        assert found.points[:, 2].min() > 0


def test_boxes_on_a_table_are_found_with_their_size_and_place():
    objects = segment(table_scene(np.random.default_rng(0)), SegmentSettings())
    check(objects)
    counts = [len(item.points) for item in objects]
    assert counts == sorted(counts, reverse=True)
    assert min(counts) > 6000  # every point that was measured, not one a voxel


@pytest.mark.parametrize("tilt", [5.0, 25.0])
def test_convention_a_tilted_scene_becomes_level_and_is_not_mirrored(tilt):
    rng = np.random.default_rng(1)
    scene = Rotation.from_euler("x", tilt, degrees=True).apply(table_scene(rng)) + 2 * UP
    # The smallest turn undoes the tilt; the table's height above the origin stays in its own axes.
    low = Rotation.from_euler("x", -tilt, degrees=True).apply(2 * UP)
    objects = segment(scene, SegmentSettings())
    moved = [item.centre for item in objects]
    for item, place in zip(objects, moved, strict=True):
        object.__setattr__(item, "centre", (place[0] - low[0], place[1] - low[1], place[2]))
    check(objects)


@given(st.integers(0, 2**32 - 1), st.floats(0, 40))
def test_a_plane_is_found_among_strays_and_looks_upwards(seed, tilt):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler("zx", [rng.uniform(0, 360), tilt], degrees=True)
    flat = np.c_[rng.random((300, 2)), rng.normal(scale=0.002, size=300) + 0.4]
    points = turn.apply(np.concatenate([flat, rng.random((200, 3))]))
    plane = fit_plane(points, 0.01, UP, seed=seed)
    assert plane.normal @ turn.apply(UP) > np.cos(np.radians(2))
    assert plane.offset == pytest.approx(0.4, abs=0.02)
    again = fit_plane(points, 0.01, UP, seed=seed)
    np.testing.assert_array_equal(plane.normal, again.normal)


def test_a_wall_is_no_table_until_it_is_asked_for():
    rng = np.random.default_rng(0)
    wall = np.c_[rng.random(5000), np.full(5000, 0.3), rng.random(5000)]
    assert fit_plane(wall, 0.01, UP) is None
    standing = fit_plane(wall, 0.01, UP, tilt=90.0)
    assert abs(standing.normal[1]) == pytest.approx(1)
    assert fit_plane(wall[:2], 0.01, UP) is None


def test_the_same_seed_gives_the_same_and_the_order_of_points_hardly_matters():
    scene = table_scene(np.random.default_rng(2))
    one, two = (segment(scene, SegmentSettings()) for _ in range(2))
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first.points, second.points)
    check(segment(scene[::-1].copy(), SegmentSettings()))


@pytest.mark.parametrize("seed", range(4))
def test_low_parts_on_one_side_do_not_tilt_the_table(seed):
    """They lie within the tolerance in which the plane is looked for first."""
    rng = np.random.default_rng(seed)
    points = [surface((0.8, 0.6, 0.0), (-0.4, -0.3, 0.0), 40_000, rng)]
    for x, y in ((0.25, 0.2), (0.3, 0.05), (0.2, 0.12)):
        points.append(surface((0.1, 0.08, 0.0), (x, y, 0.009), 1500, rng))
    points = np.concatenate(points)
    points[:, 2] += rng.normal(scale=0.0008, size=len(points))
    points[:, 2] -= 0.8  # the camera is the origin
    table = find_table(points, SegmentSettings(), -points[:, 2])
    cosine = table.from_scene[2, 2]
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.1
    np.testing.assert_allclose(table.from_scene[2, 3], 0.8, atol=0.0003)
    assert 0.0008 / 0.64 * 0.7 < table.noise < 0.0008 / 0.64 * 1.2


@pytest.mark.parametrize("down", [90.0, 60.0, 40.0])
def test_noise_of_a_wide_picture_is_that_of_its_depth(down):
    """A stereo camera's noise grows with the square of the depth, not of the distance, and moves
    points along their rays: less of it is seen across a plane that they meet at a slant."""
    rng, depth_noise, height = np.random.default_rng(0), 0.002, 0.5
    v, u = np.mgrid[-180:180:3, -320:320:3]
    rays = np.stack([u / 320, v / 320, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    s, c = np.sin(np.radians(down)), np.cos(np.radians(down))
    steep = rays @ (0.0, c, s)  # how much lower a ray is at depth 1
    depth = height / np.where(steep > 0, steep, np.nan)
    depth = depth[near := depth < 3 * height]
    depth += rng.normal(size=len(depth)) * depth_noise * depth**2
    gravity = (0.0, float(c), float(s))
    scene = turn(upright(gravity), depth[:, None] * rays[near])
    table = seen_table(scene, SegmentSettings(gravity=gravity))
    np.testing.assert_allclose(table.noise, depth_noise, rtol=0.1)


@pytest.mark.parametrize(("down", "height", "high"), [(35.0, 0.45, 0.008), (25.0, 0.3, 0.004)])
def test_wrinkles_of_a_cloth_at_a_slant_belong_to_the_table(down, height, high):
    """They are as high at any slant, and there they seem more noise of depth than a camera has."""
    v, u = np.mgrid[-120:120:2, -160:160:2]
    rays = np.stack([u / 300, v / 300, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    s, c = np.sin(np.radians(down)), np.cos(np.radians(down))
    steep = rays @ (0.0, c, s)
    rays, steep = rays[steep > 0.1], steep[steep > 0.1]
    depth = height / steep
    for _ in range(8):  # a ray ends where the cloth is as high as the ray
        across, along = depth * rays[:, 0], depth * (rays @ (0.0, s, -c))
        wave = high * np.sin(along / 0.03) * np.sin(across / 0.03)
        depth = (height - wave) / steep
    depth += np.random.default_rng(0).normal(size=len(depth)) * 0.0005 * depth**2
    gravity = (0.0, float(c), float(s))
    scene = turn(upright(gravity), depth[:, None] * rays)
    table = seen_table(scene, SegmentSettings(gravity=gravity))
    off = np.abs(turn(table.from_scene[:3, :3], scene)[:, 2] + table.from_scene[2, 3])
    assert np.mean(off > table.tolerance) < 0.01


@pytest.mark.parametrize("step", [0.004, 0.006, 0.007, 0.008, 0.0095])
def test_a_table_in_two_steps_of_a_coarse_depth_is_found(step):
    """Its plane lies between them, where no point is."""
    rng = np.random.default_rng(0)
    table = surface((0.8, 0.6, 0.0), (-0.4, -0.3, 0.0), 40_000, rng)
    table[:, 2] = step * rng.integers(2, size=len(table))
    cube = surface((0.1, 0.08, 0.12), (0.1, 0.0, 0.0), 6000, rng)
    scene = np.concatenate([table, cube]) - [0, 0, 0.8]
    found = find_table(scene, SegmentSettings(), -scene[:, 2])
    assert found.from_scene[2, 2] > np.cos(np.radians(1))
    np.testing.assert_allclose(0.8 - found.from_scene[2, 3], step / 2, atol=0.0015)
    (only,) = segment(scene, SegmentSettings(), found)
    np.testing.assert_allclose(only.size, (0.1, 0.08, 0.12), atol=0.012)


@pytest.mark.parametrize("held", [0, 1, 2, 5])
def test_a_plane_that_holds_too_few_points_stays(held):
    """Five points on a line hold it no more than two."""
    plane = Plane(UP, 0.3)
    away = np.random.default_rng(0).random((50, 3)) + UP
    line = np.c_[np.arange(held), 2.0 * np.arange(held), np.full(held, 0.301)]
    kept = refit(np.concatenate([away, line]), plane, 0.01)
    np.testing.assert_array_equal(kept.normal, plane.normal)
    assert kept.offset == plane.offset


@pytest.mark.parametrize(("height", "is_cut"), [(0.5, False), (0.01, True)])
def test_an_object_that_is_cut_off_at_the_height_is_reported(rng, caplog, height, is_cut):
    TOLD.clear()
    segment(table_scene(rng), SegmentSettings(height=height))
    text = f"an object goes on above {height:g} m, and is cut off there; raise --height"
    assert (text in caplog.text) == is_cut


def test_small_high_and_near_things():
    scene = table_scene(np.random.default_rng(3))
    assert len(segment(scene, SegmentSettings(min_points=7500, tolerance=0.01))) < 3
    low = segment(scene, SegmentSettings(height=0.1))
    assert max(item.size[2] for item in low) <= 0.1
    assert len(segment(scene, SegmentSettings(gap=0.3))) == 1


@pytest.mark.parametrize("ending", [".ply", ".npz", ".xyz"])
def test_a_scene_becomes_a_folder_and_a_table(tmp_path, ending):
    from qs3.clouds.ply_writer import ply_bytes

    scene = table_scene(np.random.default_rng(0))
    path = tmp_path / f"scene{ending}"
    if ending == ".npz":
        np.savez(path, points=scene)
    elif ending == ".xyz":
        np.savetxt(path, scene, "%.9g")
    else:
        path.write_bytes(ply_bytes(scene))
    objects = segment_scene(path, tmp_path / "objects")
    check(objects)
    rows = pd.read_csv(tmp_path / "objects" / "objects.csv")
    assert rows[["distance", "elevation"]].isna().all(axis=None)  # a cloud's camera is unknown
    assert rows["file"].tolist() == [f"object_00{i}.ply" for i in range(3)]
    for row, item in zip(rows.itertuples(), objects, strict=True):
        np.testing.assert_array_equal(read_cloud(tmp_path / "objects" / row.file), item.points)
        sizes = (row.length, row.width, row.height)
        np.testing.assert_allclose(sizes, item.size, atol=1e-4)
        assert row.points == len(item.points)
    for item in objects:  # the rows of the scene are those of the object
        flat = scene[item.rows]
        np.testing.assert_allclose(
            flat[:, :2].mean(axis=0), item.points[:, :2].mean(axis=0), atol=0.01
        )
    with refused("is there already"):
        segment_scene(path, tmp_path / "objects")


def test_a_depth_image_of_a_table_seen_from_above(tmp_path):
    """Ray cast, in whole millimetres, without gravity: the camera looks down by 50°."""
    parts = [box((1.2, 0.8, 0.03), (-0.6, -0.4, -0.03))]
    for length, width, height, x, y, heading in BOXES:
        block = box((length, width, height), (-length / 2, -width / 2, 0))
        block.apply_transform(trimesh.transformations.rotation_matrix(np.radians(heading), UP))
        parts.append(block.apply_translation([x, y, 0]))
    mesh = trimesh.util.concatenate([*parts, box((4, 4, 0.1), (-2, -2, -0.8))])
    matrix = np.array([[500, 0, 239.5], [0, 500, 179.5], [0, 0, 1]])
    depth, _ = photograph(mesh, looking_down(50.0, (0.0, -0.9, 1.1)), matrix, (360, 480))
    write_png(tmp_path / "d.png", millimetres(depth))
    settings = SceneSettings(intrinsics="500,500,239.5,179.5", tilt=60.0)
    objects = segment_scene(tmp_path / "d.png", tmp_path / "o", settings)
    assert len(objects) == 3
    # The camera sees tops and near sides: heights are whole, tops tell the level sides.
    table = pd.read_csv(tmp_path / "o" / "objects.csv")
    for length, width, height, x, y, _ in BOXES:
        item = min(objects, key=lambda o: abs(o.centre[0] - x))
        away = np.array([0.0, -0.9, 1.1]) - [x, y, height / 2]  # the camera, as the object sees it
        row = table.iloc[objects.index(item)]
        assert row.distance == pytest.approx(np.linalg.norm(away), abs=0.02)
        angle = np.degrees(np.arcsin(away[2] / np.linalg.norm(away)))
        assert row.elevation == pytest.approx(angle, abs=1)
        assert item.size[2] == pytest.approx(height, abs=0.01)
        assert item.size[0] == pytest.approx(length, abs=0.01)
        assert item.size[1] == pytest.approx(width, abs=0.01)
    assert len(read_scene(tmp_path / "d.png", settings)[0]) > 100_000
    half = dataclasses.replace(settings, stride=2)
    few = segment(read_scene(tmp_path / "d.png", half)[0], half)
    for one, other in zip(objects, few, strict=True):
        assert len(other.points) == pytest.approx(len(one.points) / 4, rel=0.05)
        np.testing.assert_allclose(other.centre, one.centre, atol=0.01)


@pytest.mark.parametrize("gravity", [None, (0.0, 0.77, 0.64)])
def test_convention_scene_json_leads_from_the_table_to_the_camera(tmp_path, gravity):
    mesh = trimesh.util.concatenate(
        [box((1.2, 0.8, 0.03), (-0.6, -0.4, -0.03)), box((0.2, 0.1, 0.12), (-0.2, 0.05, 0))]
    )
    matrix = np.array([[400, 0, 171.0], [0, 390, 118.0], [0, 0, 1]])
    eye = (0.05, -0.7, 0.8)
    depth, _ = photograph(mesh, looking_down(50.0, eye), matrix, (240, 320))
    write_png(tmp_path / "d.png", millimetres(depth))
    camera = {"fx": 400, "fy": 390, "cx": 171, "cy": 118, "width": 320, "height": 240}
    (tmp_path / "cam.json").write_text(json.dumps(camera))
    settings = SceneSettings(intrinsics=str(tmp_path / "cam.json"), gravity=gravity)
    (item,) = segment_scene(tmp_path / "d.png", tmp_path / "o", settings)
    place = json.loads((tmp_path / "o" / "scene.json").read_text())
    assert place["scene"] == "d.png"
    assert place["intrinsics"] == camera
    to_camera = np.array(place["camera_from_table"])
    np.testing.assert_allclose(np.linalg.inv(to_camera)[:3, 3], place["camera"], atol=1e-9)
    assert place["camera"][2] == pytest.approx(eye[2], abs=0.002)
    seen = item.points @ to_camera[:3, :3].T + to_camera[:3, 3]
    pixels = (seen @ matrix.T)[:, :2] / seen[:, 2:]
    np.testing.assert_allclose(pixels, np.rint(pixels), atol=1e-3)
    u, v = np.rint(pixels).astype(int).T
    np.testing.assert_allclose(seen[:, 2], np.rint(depth[v, u] * 1000) / 1000, atol=1e-6)


@pytest.mark.parametrize("gravity", [None, (0.1, 0.0, -1.0)])
@pytest.mark.parametrize("away", [(0.3, 2.0, -1.0), (500000.3, 4600002.0, -1.0)])
def test_convention_scene_json_of_a_cloud_leads_from_the_table_to_the_file(tmp_path, gravity, away):
    turn = Rotation.from_euler("x", 10, degrees=True)
    scene = turn.apply(table_scene(np.random.default_rng(0))) + np.array(away)
    np.save(tmp_path / "c.npy", scene)
    settings = SceneSettings(gravity=gravity)
    objects = segment_scene(tmp_path / "c.npy", tmp_path / "o", settings)
    place = json.loads((tmp_path / "o" / "scene.json").read_text())
    assert set(place) == {"scene", "cloud_from_table"}
    back = np.array(place["cloud_from_table"])
    for item in objects:
        points = item.points @ back[:3, :3].T + back[:3, 3]
        np.testing.assert_allclose(points, scene[item.rows], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("roll", "down", "advice"),
    [
        (180, 30, "0 -1 0"), (180, 45, "0 -1 0"), (180, 55, "0 -1 0"), (90, 45, "1 0 0"),
        (-90, 50, "-1 0 0"), (0, 89, "0 0 1"), (0, 60, ""), (0, 20, ""), (40, 45, ""),
    ],
)  # fmt: skip
def test_a_turned_camera_is_recognised_from_the_plane(tmp_path, roll, down, advice):
    mesh = trimesh.util.concatenate(
        [box((1.4, 1.4, 0.03), (-0.7, -0.7, -0.03)), box((0.1, 0.06, 0.08), (-0.05, -0.03, 0))]
    )
    angle = np.radians(down)
    pose = looking_down(down, (0.0, -0.7 * np.cos(angle), 0.7 * np.sin(angle)))
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    matrix = np.array([[260, 0, 119.5], [0, 260, 119.5], [0, 0, 1]])
    write_png(tmp_path / "d.png", millimetres(photograph(mesh, pose, matrix, (240, 240))[0]))
    settings = SceneSettings(intrinsics="260,260,119.5,119.5")
    (item,) = segment_scene(tmp_path / "d.png", tmp_path / "o", settings)
    np.testing.assert_allclose(item.size, (0.1, 0.06, 0.08), atol=0.004)
    place = json.loads((tmp_path / "o" / "scene.json").read_text())
    to_camera = np.array(place["camera_from_table"])
    up = np.linalg.inv(pose[:3, :3]) @ UP
    assert np.degrees(np.arccos(to_camera[:3, 2] @ up)) < 1
    gravity = tuple(float(number) for number in (advice or "0 1 0").split())
    settings = dataclasses.replace(settings, gravity=gravity)
    (same,) = segment_scene(tmp_path / "d.png", tmp_path / "given", settings)
    np.testing.assert_allclose(same.size, item.size, atol=0.002)


@pytest.mark.parametrize("name", ["sc.png", "sc180.png"])
def test_the_small_scene_is_cut_also_upside_down(tmp_path, shared_data, name):
    faults = shared_data / "faults"
    settings = SceneSettings(intrinsics=str(faults / "cam.json"))
    (item,) = segment_scene(faults / name, tmp_path / "o", settings)
    np.testing.assert_allclose(item.size, (0.1, 0.06, 0.08), atol=0.002)


@pytest.mark.parametrize(("gravity", "fix"), [(None, "give"), ((0.0, 0.0, -1.0), "check")])
def test_gravity_that_is_given_is_not_asked_for(rng, gravity, fix):
    wall = np.c_[rng.random(4000), np.full(4000, 1.0), rng.random(4000)]
    settings = SegmentSettings(gravity=gravity)
    with refused(f"{fix} --gravity"):
        find_table(wall, settings)
    table = Table(np.eye(4), np.full(4000, 0.003), 0.02, 0.001)
    through = rng.random((4000, 3)) * [1, 1, 0.02] - [0, 0, 0.01]
    with refused(f"cuts through a surface; {fix} --gravity"):
        require_surface(through, table, settings)


def test_gravity_that_is_given_and_wrong_is_refused(tmp_path, shared_data):
    faults = shared_data / "faults"
    settings = SceneSettings(intrinsics=str(faults / "cam.json"), gravity=(0.0, 1.0, 0.0))
    with refused("gravity", "sc180.png"):
        segment_scene(faults / "sc180.png", tmp_path / "o", settings)


@pytest.mark.parametrize(("side", "advice"), [(1, "--gravity 0 1 0"), (-1, "--gravity 0 -1 0")])
def test_a_cloud_in_a_cameras_axes_suggests_gravity(tmp_path, caplog, side, advice):
    """OpenCV's axes, and those of RealSense's viewer (y up, z backwards)."""
    points = table_scene(np.random.default_rng(0))
    for down in (5.0, 50.0):
        to_camera = np.linalg.inv(looking_down(down, (0.0, -1.1 if down > 5 else -2.0, 1.1)))
        seen = points @ to_camera[:3, :3].T + to_camera[:3, 3]
        np.save(tmp_path / "c.npy", seen * [1, side, side])
        caplog.clear()
        try:
            objects = segment_scene(tmp_path / "c.npy", tmp_path / f"o{down}")
        except InputError as error:
            assert advice in str(error)
        else:
            # Looking down by 50°, what is backwards is up within the tilt of 60°: nothing is wrong.
            assert advice in caplog.text if side > 0 else len(objects) == 3
        gravity = (0.0, float(side), 0.0)
        settings = SceneSettings(gravity=gravity)
        assert len(segment_scene(tmp_path / "c.npy", tmp_path / f"g{down}", settings)) == 3
    assert "--gravity" not in caplog.text


def test_settings_are_in_metres_and_fit_together():
    for settings, message in (
        ({"gap": 0.0}, r"gap 0\.0 must be above 0"),
        ({"far": 1200.0}, r"far 1200\.0 must be above 0 and at most 50"),
        ({"tolerance": 0.5}, r"tolerance 0\.5: must be below height 0\.5"),
        ({"tilt": 91.0}, "tilt"),
        ({"gravity": (0.0, 0.0, 0.0)}, "gravity"),
    ):
        with pytest.raises(InputError, match=message):
            SegmentSettings(**settings)


def test_objects_of_a_scene_in_centimetres_are_asked_about(tmp_path, caplog, rng):
    TOLD.clear()
    table = np.c_[rng.random((4000, 2)), np.zeros(4000)]
    flat = np.c_[0.3 + 0.2 * rng.random((2000, 2)), np.full(2000, 0.003)]
    for unit, asked in ((1.0, False), (80.0, True)):
        np.save(tmp_path / "s.npy", np.r_[table, flat * [1, 1, 0.4 / (0.003 * unit)]] * unit)
        segment_scene(tmp_path / "s.npy", tmp_path / str(unit), SceneSettings(gap=0.1 * unit))
        assert ("m wide: is the scene in metres?" in caplog.text) == asked


def test_what_has_no_plane_or_nothing_on_it_is_one_line(tmp_path):
    rng = np.random.default_rng(0)
    bare = np.c_[rng.random((20_000, 2)), np.zeros(20_000)]
    line = np.c_[np.linspace(0, 1, 5000), np.zeros((5000, 2))] + rng.normal(scale=1e-4, size=3)
    for name, points, message in (
        ("fog", rng.random((20_000, 3)), "no plane within 60° of level"),
        ("bare", bare, "nothing stands on its plane"),
        ("line", np.r_[line, rng.random((5000, 3)) * 9], "no patch without gaps"),
        ("tiny", bare * 1e-3, "all of it is within 5 cm: is its unit right"),
        ("mm", rng.random((100, 3)) * 1200, "metres per step"),
        ("close", rng.random((100, 3)) * 300, "or divide millimetres by 1000"),
        ("blind", np.zeros((2, 3)), "2 points: no depth in it"),
    ):
        np.save(tmp_path / f"{name}.npy", points)
        with refused(message, f"{name}.npy"):
            segment_scene(tmp_path / f"{name}.npy", tmp_path / "o")
    with refused("--depth-scale: is of depth images", "fog.npy"):
        segment_scene(tmp_path / "fog.npy", tmp_path / "o", SceneSettings(depth_scale=0.001))
    np.savez(tmp_path / "two.npz", points=rng.random((2, 9, 3)))
    with refused(r"shape \[n 3\]", "two.npz"):
        segment_scene(tmp_path / "two.npz", tmp_path / "o")
    assert not (tmp_path / "o").exists()
