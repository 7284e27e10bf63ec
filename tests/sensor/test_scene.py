"""Where floor, wall and neighbour stand, what is seen of the object, and what is refused."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.meshes import normalise
from qs3.sensor.depth import DepthSettings
from qs3.sensor.light import Body
from qs3.sensor.light.mitsuba import MitsubaRenderer
from qs3.sensor.light.pattern import PatternSettings
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.placement import Placement, place_views
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import Pose, StereoRig
from qs3.sensor.scan import scan
from qs3.sensor.stage.obstacles import check_views
from qs3.sensor.stage.scene import SceneSettings, arrange

TINY = Sensor(
    name="tiny",
    rig=StereoRig(width=300, height=300, focal=420.0, baseline=0.2),
    matching=MatchingSettings(num_disparities=64, block_size=9),
    depth=DepthSettings(stride=1),
    # As many pixels per cell as `paper` has.
    pattern=PatternSettings(columns=177, rows=138),
    placement=Placement(radius=(2.6, 3.0)),
)


def around(layout: str, seed: int = 0, views: int = 5, kind="orbit", **options) -> SimpleNamespace:
    rng = np.random.default_rng(seed)
    settings = SceneSettings(layout, **options)
    mesh = normalise(shapes.make("chair", seed=seed))
    other = normalise(shapes.make("table", seed=seed)) if settings.needs_neighbour else None
    poses = place_views(views, kind, Placement(), rng)
    bodies, poses = arrange(settings, Body(mesh), poses, 1.0, other, rng)
    return SimpleNamespace(bodies=bodies, poses=poses)


def azimuths(poses) -> np.ndarray:
    return np.array([np.arctan2(p.position[1], p.position[0]) for p in poses])


def part(staged, name: str) -> trimesh.Trimesh:
    return staged.bodies[name].mesh


def test_the_floor_touches_the_object_from_below():
    staged = around("floor")
    height = part(staged, "floor").vertices[:, 2]
    assert np.ptp(height) == 0
    assert 0 < part(staged, "object").vertices[:, 2].min() - height[0] < 2e-4
    np.testing.assert_allclose(part(staged, "floor").face_normals, [[0, 0, 1]] * 2, atol=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_convention_the_wall_is_behind_everything_as_the_first_view_sees_it(seed):
    staged = around("room+beside", seed=seed)
    wall = part(staged, "wall")
    normal = wall.face_normals[0]
    front = staged.poses[0].position * [1, 1, 0]
    np.testing.assert_allclose(normal, front / np.linalg.norm(front), atol=1e-9)
    gaps = [
        ((part(staged, n).vertices - wall.vertices[0]) @ normal).min()
        for n in list(staged.bodies)[:2]
    ]
    assert min(gaps) == pytest.approx(0.3, abs=1e-9)
    # It stands on the floor, and every camera is on its free side, looking at the object.
    floor = part(staged, "floor").vertices[0, 2]
    assert wall.vertices[:, 2].min() == pytest.approx(floor)
    for pose in staged.poses:
        assert (pose.position - wall.vertices[0]) @ normal > 1
        np.testing.assert_allclose(
            np.cross(pose.camera_to_world[:3, 2], pose.position), 0, atol=1e-9
        )


@pytest.mark.parametrize("layout", ["wall", "room", "behind"])
def test_views_stay_on_the_arc_and_keep_height_and_distance(layout):
    free, narrow = around("alone", seed=2), around(layout, seed=2, arc=100.0)
    offset = np.degrees(np.angle(np.exp(1j * (azimuths(narrow.poses) - azimuths(narrow.poses)[0]))))
    np.testing.assert_allclose(offset, [0, 20, -20, 40, -40], atol=1e-9)
    for a, b in zip(free.poses, narrow.poses, strict=True):
        assert a.position[2] == pytest.approx(b.position[2])
        assert np.linalg.norm(a.position) == pytest.approx(np.linalg.norm(b.position))


@pytest.mark.parametrize("layout", ["floor", "beside"])
def test_views_go_all_round_where_nothing_is_in_the_way(layout):
    offset = np.diff(np.unwrap(azimuths(around(layout).poses)))
    np.testing.assert_allclose(np.degrees(offset), 72, atol=1e-9)


@pytest.mark.parametrize("name", shapes.CLASSES[::3])
def test_a_neighbour_in_front_hides_a_part(name, seed=1):
    rng = np.random.default_rng(seed)
    mesh = normalise(shapes.make(name, seed=seed))
    crate = trimesh.creation.box(extents=[0.9, 0.7, 1.0])
    poses = place_views(1, "orbit", Placement(), rng)
    bodies, poses = arrange(SceneSettings("behind"), Body(mesh), poses, 1.0, crate, rng)
    check_views(bodies, poses, Sensor())
    rig = StereoRig(width=270, height=270, focal=375.0)
    both = DepthCaster(*(body.mesh for body in bodies.values()))
    seen = both.cast(rig, poses[0], rig.full_frame).mask
    alone = DepthCaster(mesh).cast(rig, poses[0], rig.full_frame).mask
    assert not (seen & ~alone).any()
    assert 1 - seen.sum() / alone.sum() == pytest.approx(0.3, abs=0.1)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("layout", ["behind", "beside", "room+behind", "floor+beside"])
def test_nothing_stands_in_anything(layout, seed):
    staged = around(layout, seed=seed)
    other, mesh = part(staged, "neighbour"), part(staged, "object")
    # A plane parts the two: along the line of sight, or sideways.
    sight = staged.poses[0].position / np.linalg.norm(staged.poses[0].position)
    flat = sight * [1, 1, 0]
    side = np.cross([0, 0, 1], flat / np.linalg.norm(flat))
    ways = sight, -sight, side, -side
    assert max((other.vertices @ d).min() - (mesh.vertices @ d).max() for d in ways) > 0.1
    if "floor" in staged.bodies:
        assert other.vertices[:, 2].min() >= part(staged, "floor").vertices[0, 2] - 1e-9
    elif layout == "beside":
        assert other.vertices[:, 2].min() == pytest.approx(mesh.vertices[:, 2].min())


def test_a_neighbour_too_many_or_too_few_is_refused(renderer):
    box = trimesh.creation.box(extents=[1, 1, 1])
    with pytest.raises(InputError, match="needs a neighbour"):
        scan(box, sensor=TINY, scene="behind", renderer=renderer)
    with pytest.raises(InputError, match="has no neighbour"):
        scan(box, sensor=TINY, scene="room", neighbour=box, renderer=renderer)


def with_placement(**options) -> Sensor:
    return dataclasses.replace(TINY, placement=Placement(**options))


BOX = trimesh.creation.box(extents=[1.0, 0.9, 0.8])


@pytest.mark.parametrize(
    ("sensor", "scene", "message"),
    [
        (with_placement(radius=(0.2, 0.2)), "alone", "camera stands inside the object's hull"),
        (with_placement(radius=(0.6, 0.6), elevation=(-60.0, -60.0)), "floor", "under the floor"),
        (with_placement(radius=(0.9, 0.9)), "behind", "no room for a neighbour"),
        (
            dataclasses.replace(
                TINY,
                rig=StereoRig(300, 300, 420.0, 0.3, projector_offset=-10.0),
                pattern=PatternSettings(columns=177, rows=138, tan_half_width=0.2),
            ),
            "alone",
            "past the object",
        ),
        (
            dataclasses.replace(
                TINY,
                rig=StereoRig(300, 300, 420.0, 0.25, projector_offset=4.0),
                placement=Placement(radius=(0.9, 0.9), elevation=(0.0, 0.0)),
                object_size=2.0,
            ),
            "alone",
            "stands inside the object's hull",
        ),
    ],
)
def test_a_rig_in_the_way_is_refused_before_rendering(sensor, scene, message):
    none = SimpleNamespace(description={"name": "none"}, render=lambda *_: pytest.fail("rendered"))
    other = BOX if "be" in scene else None
    with pytest.raises(InputError, match=message):
        scan(BOX, sensor=sensor, scene=scene, neighbour=other, renderer=none, views=1)


def test_a_camera_may_stand_beside_a_turned_block():
    turn = trimesh.transformations.rotation_matrix(np.pi / 4, [0, 0, 1])
    part = np.array([-0.9, 0.9, 0.0])
    poses = [Pose.looking_at(np.array([at, at, 0.1]), part) for at in (0.35, 0.05)]
    block = trimesh.creation.box(extents=[0.3, 1.0, 0.4], transform=turn)
    small = trimesh.creation.box(extents=[0.03, 0.02, 0.01])
    small.apply_translation(part)
    bodies = {"object": Body(small), "neighbour": Body(block)}
    sensor = dataclasses.replace(Sensor(), rig=StereoRig(baseline=0.02))
    check_views(bodies, poses[:1], sensor)
    with pytest.raises(InputError, match="view 1: the camera stands inside the neighbour's hull"):
        check_views(bodies, poses, sensor)


@pytest.fixture(scope="module")
def quick() -> MitsubaRenderer:
    return MitsubaRenderer(variant="scalar_rgb", samples=2)


@pytest.fixture(scope="module")
def scans(quick):
    chair, table = shapes.make("chair", seed=1), shapes.make("table", seed=2)
    return {
        layout: scan(
            chair,
            sensor=TINY,
            views=1,
            seed=5,
            num_points=2000,
            scene=layout,
            neighbour=table if "be" in layout else None,
            crop="none",
            renderer=quick,
            full_frames=layout == "room",
            keep_images=True,
        )
        for layout in ("alone", "room", "behind", "room+beside")
    }


def test_the_clean_twin_is_the_object_alone_in_every_scene(scans):
    for layout, one in scans.items():
        exact = trimesh.proximity.closest_point(one.mesh, one.clean[::3])[1]
        assert exact.max() < 1e-5, layout


def test_statistics_are_of_the_object_in_every_scene(scans):
    for layout, one in scans.items():
        for view, images in zip(one.views, one.images, strict=True):
            assert view.object_pixels == images.mask.sum() > 1000
            assert view.valid_fraction > 0.3, layout
            assert abs(view.disparity_bias) < 0.15, layout
            if layout in ("room", "room+beside"):
                assert view.ring_fraction is None


def test_floor_and_wall_are_measured_where_they_stand(scans):
    images = scans["room"].images[0]
    around_it = ~images.silhouette & np.isfinite(images.depth) & np.isfinite(images.true_depth)
    error = (images.depth - images.true_depth)[around_it]
    sigma = 3.5**2 * 0.4 / (420 * 0.2)
    assert abs(np.median(error)) < 0.5 * sigma
    assert np.median(np.abs(error)) < sigma
    assert around_it.mean() > 0.3


def test_crops_keep_box_or_mask(quick):
    common = {"sensor": TINY, "views": 1, "seed": 5, "num_points": 500, "scene": "floor"}
    chair = shapes.make("chair", seed=1)
    counts = {}
    for name, options in {
        "none": {"crop": "none"},
        "margin": {"box_margin": 0.1},
        "box": {},
        "mask": {"crop": "mask"},
        "both": {"crop": "both"},
    }.items():
        result = scan(chair, renderer=quick, **common, **options)
        counts[name] = result.fused_points
        if name in ("margin", "box", "both"):
            turned = result.points.astype(float) @ rotation_z(result.yaw).T
            corners = result.mesh.vertices @ rotation_z(result.yaw).T
            margin = options.get("box_margin", 0.0) + 1e-5
            assert (turned >= corners.min(axis=0) - margin).all()
            assert (turned <= corners.max(axis=0) + margin).all()
    assert counts["none"] > counts["margin"] > counts["box"] > counts["both"]
    assert counts["none"] > counts["mask"] > counts["both"]
