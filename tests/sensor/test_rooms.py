"""Rooms: drawn within their ranges, from the scan's seed alone, and again where little shows."""

import dataclasses
import itertools
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.meshes.sizes import CLASS_SIZES
from qs3.sensor.depth import DepthSettings
from qs3.sensor.light import Body
from qs3.sensor.placement import Placement, place_views
from qs3.sensor.presets import SENSORS
from qs3.sensor.rig import StereoRig
from qs3.sensor.scan import scan
from qs3.sensor.stage import stage
from qs3.sensor.stage.randomise import default_ranges, draw_room, resolve_ranges
from qs3.sensor.stage.rooms import PLACE, ROOM_RANGES, Room
from qs3.sensor.stage.scene import SceneSettings, arrange
from qs3.sensor.stage.settings import ScanSettings

D435 = SENSORS["d435"]
# A quarter of the D435's pixels and spots.
TINY = dataclasses.replace(
    D435,
    name="tiny",
    rig=StereoRig(width=424, height=240, focal=215.0, baseline=0.05),
    pattern=dataclasses.replace(D435.pattern, columns=135, rows=84),
    matching=dataclasses.replace(D435.matching, num_disparities=64, block_size=15),
    depth=DepthSettings(near=0.2, far=8.0, stride=1),
)
ALL = ["rooms", "material=diffuse"]
STILL = dataclasses.replace(
    TINY,
    light=dataclasses.replace(TINY.light, ambient=0.005),
    exposure=dataclasses.replace(TINY.exposure, noise=0.0, speckle=7.0, coherent=0.0),
)
"""In the dark, and each view is rendered once."""


def chair(**options):
    options = {"sensor": TINY, "views": 1, "num_points": 64, "least_pixels": 20} | options
    return scan(shapes.make("chair", seed=5), class_names=["chair"], **options)


def turned(seed: int = 0) -> trimesh.Trimesh:
    mesh = shapes.make("plant", seed=seed)
    mesh.vertices -= mesh.bounds.mean(axis=0)
    return mesh


def test_rooms_are_the_default_ranges_and_places_and_words_replace_them():
    ranges = resolve_ranges(D435, "rooms")
    assert ranges == dict(sorted((default_ranges(D435) | ROOM_RANGES).items()))
    words = ["rooms", "room.distance=1:2", "room.layout=floor,room+table"]
    narrow = resolve_ranges(D435, words)
    assert narrow["room.distance"] == (1.0, 2.0)
    assert narrow["room.layout"] == ("floor", "room+table")
    assert set(narrow) == set(ranges)
    assert set(resolve_ranges(D435, ["room.distance=1:2"])) == set(ROOM_RANGES)
    assert resolve_ranges(D435, narrow) == narrow  # as the records have it


def test_draws_of_rooms_keep_to_their_ranges_and_follow_their_seed():
    ranges = resolve_ranges(D435, "rooms")
    seen = set()
    for seed in range(100):
        room, drawn = draw_room(ranges, np.random.default_rng(seed))
        assert (room, drawn) == draw_room(ranges, np.random.default_rng(seed))
        assert {f"room.{k}": v for k, v in dataclasses.asdict(room).items()} == drawn
        seen.add(room.layout)
        for name, values in ROOM_RANGES.items():
            if name != "room.layout":
                assert values[0] <= drawn[name] <= values[1]
    assert seen == set(ROOM_RANGES["room.layout"])


@pytest.mark.parametrize("layout", ["floor", "room", "room+table"])
@pytest.mark.parametrize("seed", range(3))
def test_the_camera_stands_as_high_and_as_far_as_drawn(layout, seed):
    room, _ = draw_room(resolve_ranges(D435, "rooms"), np.random.default_rng(seed))
    room = dataclasses.replace(room, layout=layout)
    mesh = turned(seed)
    low, high = mesh.bounds
    (pose,) = place_views(1, "orbit", room.placement(mesh.bounds), np.random.default_rng(0))
    size = float(mesh.extents.max())
    scene = room.scene(SceneSettings(), size)
    bodies, _ = arrange(scene, Body(mesh), [pose], size, None, np.random.default_rng(0))
    floor = bodies["floor"].mesh.vertices[:, 2]
    assert pose.position[2] - floor.max() == pytest.approx(room.height, abs=1e-3)
    assert np.degrees(np.arctan2(pose.position[1], pose.position[0])) % 360 == pytest.approx(
        room.azimuth % 360
    )
    # Along the floor from the side of a box about the origin as wide as its farther side.
    half = np.maximum(high, -low)[:2]
    way = pose.position[:2] / np.linalg.norm(pose.position[:2])
    side = (half / np.abs(way)).min()
    assert np.linalg.norm(pose.position[:2]) - side == pytest.approx(room.distance)
    if layout == "room+table":
        top = bodies["table"].mesh
        assert top.bounds[1, 2] - floor.max() == pytest.approx(room.table)
        assert low[2] - top.bounds[1, 2] == pytest.approx(0, abs=1e-3)  # the object stands on it
        assert (top.bounds[0, :2] < low[:2]).all()
        assert (top.bounds[1, :2] > high[:2]).all()
        assert top.is_watertight


def test_a_camera_before_a_lamp_on_a_desk_stands_as_high_above_the_floor_as_drawn(renderer):
    """And not above the desk: the support is drawn before the camera's place."""
    lamp = shapes.make("lamp", seed=1)
    settings = ScanSettings(
        sensor=TINY, views=1, least_pixels=1, object_size=0.45, renderer=renderer
    )
    ranges = [*ALL, "room.layout=room", "room.aim_x=0:0", "room.aim_y=0:0", "room.height=1.5:1.6"]
    settings, supports = dataclasses.replace(settings, randomise=ranges), []
    for seed in range(6):
        staged = next(stage.stages(lamp, settings, stage.Streams.of(seed), class_names=["lamp"]))
        supports.append(staged.drawn["room.support"])
        floor = staged.bounds[0, 2] - staged.drawn["room.support"]
        assert staged.poses[0].position[2] - floor == pytest.approx(staged.drawn["room.height"])
        again = next(stage.stages(lamp, settings, stage.Streams.of(seed), class_names=["lamp"]))
        assert again.drawn == staged.drawn
    desks = [support for support in supports if support > 0]
    assert desks and 0.4 <= min(desks) <= max(desks) <= 0.8


def test_a_table_stands_under_the_neighbour_too():
    mesh, other = turned(0), turned(1)
    pose = place_views(1, "orbit", Placement(), np.random.default_rng(0))
    bodies, _ = arrange(
        SceneSettings("table+beside"), Body(mesh), pose, 1.0, other, np.random.default_rng(0)
    )
    assert list(bodies) == ["object", "neighbour", "table"]
    top = bodies["table"].mesh.convex_hull
    for name in ("object", "neighbour"):
        vertices = bodies[name].mesh.vertices
        assert vertices[:, 2].min() == pytest.approx(mesh.bounds[0, 2])
        assert top.contains(vertices * [1, 1, 0] + [0, 0, mesh.bounds[0, 2] - 0.015]).all()


@pytest.mark.parametrize("kind", ["orbit", "jitter"])
def test_the_object_is_seen_opposite_of_where_the_camera_aims(kind):
    room = Room(aim_x=-0.3, aim_y=0.35)
    placement = Placement(radius=(2.0, 2.0))
    for pose in place_views(3, kind, placement, np.random.default_rng(1)):
        before, _ = D435.rig.project(np.zeros((1, 3)), pose)
        after, _ = D435.rig.project(np.zeros((1, 3)), room.aimed(pose, D435.rig))
        moved = (after - before)[0] / [D435.rig.width / 2, D435.rig.height / 2]
        assert (moved * [1, -1] > 0.1).all()
        if kind == "orbit":
            down = pose.camera_to_world[:3, :2] @ [-0.3 * D435.rig.width, 0.35 * D435.rig.height]
            target = (down / D435.rig.focal)[None]  # half of the image, at 2 m
            middle, _ = D435.rig.project(target, room.aimed(pose, D435.rig))
            np.testing.assert_allclose(middle[0], D435.rig.principal_point, atol=1e-6)


def test_a_scan_in_a_room_records_its_draws_and_equals_itself(fresh_renderer):
    a, b = (chair(randomise=ALL, seed=3, renderer=fresh_renderer) for _ in range(2))
    np.testing.assert_array_equal(a.points, b.points)
    assert a.drawn == b.drawn
    assert set(a.drawn) == {
        "exposure.gain", "light.ambient", "light.projector", "material", "object_size",
        "room.redraws", "room.support", *ROOM_RANGES,
    }  # fmt: skip
    assert a.mesh.extents.max() == pytest.approx(a.drawn["object_size"]) == a.sensor.object_size
    assert CLASS_SIZES["chair"][0][0] <= a.drawn["object_size"] <= CLASS_SIZES["chair"][0][1]
    assert np.linalg.norm(a.poses[0].position) == pytest.approx(a.sensor.placement.radius[0])
    assert a.views[0].object_pixels >= 20


def test_a_room_that_shows_little_is_drawn_again_and_counted(renderer):
    free, strict = (
        chair(randomise=ALL, seed=3, renderer=renderer, least_pixels=n) for n in (20, 5000)
    )
    assert free.drawn["room.redraws"] == 0
    assert free.views[0].object_pixels < 5000 <= strict.views[0].object_pixels
    assert strict.drawn["room.redraws"] > 0
    names = {"material", "object_size", "light.ambient", "light.projector", "exposure.gain"}
    assert all(free.drawn[name] == strict.drawn[name] for name in names)  # the room alone is drawn
    with pytest.raises(InputError, match=r"50 rooms in a row.*least_pixels is 101760"):
        chair(randomise=ALL, least_pixels=424 * 240, renderer=renderer)


def shutter(renderer, dark, rows=slice(None)):
    """A renderer whose first pictures are black in some rows."""
    taken = itertools.count()

    def render(*arguments):
        pairs = renderer.render(*arguments)
        if next(taken) >= dark:
            return pairs
        for pair in pairs:
            pair.left[rows], pair.right[rows] = 0, 0
        return [dataclasses.replace(pair, background=0.0) for pair in pairs]

    return SimpleNamespace(description=renderer.description, render=render)


def test_a_room_of_which_the_sensor_gets_little_is_drawn_again(renderer, monkeypatch):
    options = {"sensor": STILL, "randomise": ALL, "seed": 3, "crop": "mask"}
    monkeypatch.setattr(
        sys.modules[scan.__module__], "_LEAST_PIXELS", 32
    )  # the poor room is no scrap
    whole, poor, again = (
        chair(renderer=shutter(renderer, dark, slice(8, None)), least_valid=least, **options)
        for dark, least in ((0, 0.5), (1, 0.0), (1, 0.5))
    )
    assert 0 < poor.views[0].valid_fraction < 0.5 < again.views[0].valid_fraction
    assert poor.drawn == whole.drawn
    assert (poor.drawn["room.redraws"], again.drawn["room.redraws"]) == (0, 1)
    assert again.drawn["room.height"] != whole.drawn["room.height"]
    assert again.drawn["object_size"] == whole.drawn["object_size"]
    monkeypatch.setattr(stage, "_MOST_DRAWS", 3)
    with pytest.raises(InputError, match=r"3 rooms in a row.*saw too few points of"):
        chair(renderer=shutter(renderer, dark=99), **options)


def test_each_view_of_a_room_has_a_height_a_distance_and_an_aim_of_its_own(renderer):
    options = {"randomise": ["rooms", "material=diffuse", "room.layout=room"], "renderer": renderer}
    three, one = (chair(views=views, seed=3, **options) for views in (3, 1))
    assert (
        three.drawn.items() >= (one.drawn | {"room.redraws": three.drawn["room.redraws"]}).items()
    )
    later = {f"room.{name}.{view}" for name in PLACE for view in (1, 2)}
    assert set(three.drawn) - set(one.drawn) == later
    assert min(view.object_pixels for view in three.views) >= 20
    floor = three.mesh.bounds[0, 2]
    azimuths = []
    for view, pose in enumerate(three.poses):
        room = {name: three.drawn[f"room.{name}" + f".{view}" * (view > 0)] for name in PLACE}
        assert pose.position[2] - floor == pytest.approx(room["height"], abs=1e-3)
        half = np.abs((three.mesh.vertices @ rotation_z(three.yaw).T)[:, :2]).max(axis=0)
        way = pose.position[:2] / np.linalg.norm(pose.position[:2])
        side = (half / np.abs(way)).min()
        assert np.linalg.norm(pose.position[:2]) - side == pytest.approx(room["distance"])
        azimuths.append(np.degrees(np.arctan2(*pose.position[1::-1])))
    turns = np.mod(np.subtract(azimuths, three.drawn["room.azimuth"]), 360)
    np.testing.assert_allclose(turns, [0, 40, 320], atol=1e-9)  # the arc before a wall


def test_copies_of_one_pose_share_one_place(renderer):
    result = chair(views=2, view_layout="jitter", randomise=ALL, seed=3, renderer=renderer)
    assert not [name for name in result.drawn if name.endswith(".1")]
    apart = np.linalg.norm(result.poses[0].position - result.poses[1].position)
    assert 0 < apart < 0.2


def test_a_later_view_that_shows_little_is_drawn_again_alone():
    mesh, alone = shapes.make("chair", seed=5), 0
    for seed in range(4):
        drawn = []
        for least in (20, 2000):
            settings = ScanSettings(sensor=TINY, views=3, least_pixels=least, randomise=ALL)
            staged = stage.stages(mesh, settings, stage.Streams.of(seed), class_names=["chair"])
            drawn.append(next(staged).drawn)
        free, strict = drawn
        if free["room.height"] == strict["room.height"]:  # the first view would do
            alone += free["room.redraws"] < strict["room.redraws"]
            changed = {name for name in free if free[name] != strict[name]} - {"room.redraws"}
            assert changed <= {f"room.{name}.{view}" for name in PLACE for view in (1, 2)}
    assert alone > 0


def test_a_large_object_is_stood_off_from_as_much_as_it_is_larger():
    bed = scan(shapes.make("bed"), sensor=TINY, views=1, object_size="file", num_points=64)
    away = (bed.sensor.object_size - TINY.object_size) / 2
    assert away > 0
    assert bed.mesh.extents.max() == pytest.approx(bed.sensor.object_size)
    assert bed.sensor.placement.radius == pytest.approx([r + away for r in TINY.placement.radius])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": "paper", "randomise": "rooms"}, "in metres, and the sensor paper is not"),
        ({"least_pixels": 0, "randomise": "rooms"}, "least_pixels"),
        ({"randomise": "rooms", "class_names": ["toilet"]}, "toilet"),
        ({"randomise": "rooms", "class_names": ()}, "object_size class"),
        ({"randomise": {"room.height": (-1, 1)}}, "height"),
        ({"randomise": {"room.layout": ("garden",)}}, "garden"),
        ({"randomise": ["rooms", "room.layout=behind"]}, "no layout of behind suits"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(changes, message):
    options = {"sensor": TINY, "views": 1, "class_names": ["chair"]} | changes
    with pytest.raises(InputError, match=message) as caught:
        scan(shapes.make("chair"), **options)
    assert "\n" not in str(caught.value)
