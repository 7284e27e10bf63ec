"""The whole chain: what goes in comes back where it was."""

import dataclasses
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from qs3 import shapes
from qs3.errors import TOLD, InputError
from qs3.geometry import rotation_z
from qs3.meshes import sample_surface
from qs3.points.grid import grid_edge
from qs3.sensor.depth import DepthSettings
from qs3.sensor.exposure import ExposureSettings
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.matching import MatchingSettings, match
from qs3.sensor.placement import Placement
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import Pose, StereoRig
from qs3.sensor.scan import Scan, scan
from qs3.sensor.stage.settings import ScanSettings
from qs3.sensor.stage.stage import Streams, stages

# A quarter of the pixels of `paper`, with its f·b = 150.
SMALL = Sensor(
    name="small",
    rig=StereoRig(width=540, height=540, focal=750.0, baseline=0.2),
    matching=MatchingSettings(num_disparities=80, block_size=11),
    depth=DepthSettings(stride=2),
)


def boxes(*parts) -> trimesh.Trimesh:
    pieces = [trimesh.creation.box(extents=e).apply_translation(c) for c, e in parts]
    return trimesh.util.concatenate(pieces)


def asymmetric() -> trimesh.Trimesh:
    return boxes(
        ([0, 0, -0.2], [1, 0.5, 0.12]),
        ([0.4, 0.3, -0.2], [0.2, 0.3, 0.12]),
        ([-0.4, 0.0, 0.1], [0.2, 0.3, 0.5]),
    )


def distance_to(mesh: trimesh.Trimesh, points) -> np.ndarray:
    dense = sample_surface(mesh, 60_000, np.random.default_rng(0))
    return cKDTree(dense).query(points)[0]


@pytest.fixture(scope="module")
def scanned(renderer) -> Scan:
    return scan(
        asymmetric(),
        sensor=SMALL,
        views=3,
        seed=4,
        num_points=1024,
        renderer=renderer,
        keep_images=True,
    )


def test_convention_fused_cloud_lies_on_the_mesh(renderer):
    # All fused points: farthest point sampling prefers the outlying ones.
    found = scan(asymmetric(), sensor=SMALL, views=3, seed=4, num_points=40_000, renderer=renderer)
    assert found.fused_points < 40_000
    distance = distance_to(found.mesh, found.points[: found.fused_points])
    # The noise law at the mean distance of 4: σz = z²·σd/(f·b), with σd as measured in the views.
    sigma = np.median([v.disparity_sigma for v in found.views])
    assert np.median(distance) < 16 * sigma / 150


@pytest.mark.parametrize("mirror", [[-1, 1, 1], [1, -1, 1], [1, 1, -1]])
def test_convention_no_mirror_image_fits(scanned, mirror):
    for cloud in (scanned.points, scanned.clean):
        fits = distance_to(scanned.mesh, cloud).mean()
        mirrored = cloud * np.array(mirror, dtype=np.float32)
        assert distance_to(scanned.mesh, mirrored).mean() > 2 * fits


def pixels_of(cloud, view, found: Scan) -> np.ndarray:
    """Row and column of each point in the frame of its view, and its depth."""
    turned, result = cloud @ rotation_z(found.yaw).T, np.empty((len(cloud), 3))
    for number, pose in enumerate(found.poses):
        rows = view == number
        pixels, depth = found.sensor.rig.project(turned[rows].astype(np.float64), pose)
        result[rows] = np.column_stack([pixels[:, ::-1], depth])
    return result


@pytest.mark.parametrize("sampling", ["farthest", "random"])
@pytest.mark.parametrize("crop", ["mask", "both", "box", "none"])
@pytest.mark.parametrize("outliers", [False, True])
def test_convention_yaw_turns_a_point_and_its_clean_twin_to_one_pixel(
    renderer, crop, sampling, outliers
):
    options = {"sensor": SMALL, "views": 2, "seed": 4, "num_points": 700, "keep_images": True}
    options |= {"crop": crop, "sampling": sampling, "remove_outliers": outliers}
    found = scan(asymmetric(), renderer=renderer, **options)
    count = len(found.clean)
    assert 0 < count <= len(found.points) == 700
    assert np.array_equal(found.clean_view, found.view[:count])
    noisy = pixels_of(found.points, found.view, found)
    true = pixels_of(found.clean, found.clean_view, found)
    assert np.abs(noisy - noisy.round())[:, :2].max() < 0.01
    np.testing.assert_array_equal(noisy[:count, :2].round(), true[:, :2].round())
    for number, images in enumerate(found.images):
        row, column = noisy[found.view == number, :2].round().astype(int).T
        place = row - images.region.y, column - images.region.x
        shows = images.mask[place]
        assert shows.sum() == (found.clean_view == number).sum()
        assert not np.flatnonzero(found.view == number)[~shows].min(initial=count) < count
        seen = images.true_depth[place][shows]
        np.testing.assert_allclose(true[found.clean_view == number, 2], seen, atol=1e-4)
    assert (count == 700) == (crop in ("mask", "both"))


def test_a_small_cloud_is_repeated_only_by_farthest_point_sampling(renderer):
    options = {"sensor": SMALL, "views": 1, "seed": 4, "num_points": 40_000, "renderer": renderer}
    repeated, once = (scan(asymmetric(), sampling=s, **options) for s in ("farthest", "random"))
    assert len(repeated.points) == 40_000
    assert len(once.points) == len(np.unique(once.points, axis=0)) == once.fused_points
    assert {*map(tuple, once.points.tolist())} == {*map(tuple, repeated.points.tolist())}


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_the_stride_thins_rows_and_columns(renderer, stride):
    options = {"sensor": SMALL, "views": 1, "seed": 4, "num_points": 40_000, "sampling": "random"}
    found = scan(asymmetric(), stride=stride, renderer=renderer, **options)
    pixels = pixels_of(found.points, found.view, found)[:, :2].round().astype(int)
    assert not (pixels % stride).any()
    assert found.sensor.depth.stride == stride


def test_metric_size_scales_mesh_cloud_and_crop(renderer):
    # One object at twice the size, seen by a rig twice as large from twice as far: the same
    # pictures, and a cloud twice as large.
    large = dataclasses.replace(
        SMALL,
        rig=dataclasses.replace(SMALL.rig, baseline=2 * SMALL.rig.baseline),
        placement=Placement(radius=(6.0, 10.0)),
        depth=DepthSettings(near=2.0, far=12.0, stride=2),
        # The projector is a point: its light falls with the square of the distance.
        light=dataclasses.replace(SMALL.light, projector=4 * SMALL.light.projector),
    )
    options = {"views": 1, "seed": 4, "num_points": 300, "renderer": renderer, "box_margin": 0.0}
    one = scan(asymmetric(), sensor=SMALL, **options)
    two = scan(asymmetric(), sensor=large, object_size=2.0, **options)
    assert two.mesh.extents.max() == pytest.approx(2.0)
    assert two.sensor.object_size == 2.0
    np.testing.assert_allclose(np.sort(two.clean), 2 * np.sort(one.clean), atol=1e-4)
    exact = trimesh.proximity.closest_point(two.mesh, two.clean)[1]
    assert exact.max() < 2e-5
    for a, b in zip(one.views, two.views, strict=True):
        assert a.object_pixels == b.object_pixels
        assert a.disparity_sigma == pytest.approx(b.disparity_sigma, rel=0.1)


def test_a_view_beyond_the_gate_is_recorded_as_empty(renderer):
    # The copies of a pose stand up to 0.1 nearer or farther; the gate ends within the object's
    # nearest corner, so that only some views have it within reach.
    def scanned_to(far: float) -> Scan:
        sensor = dataclasses.replace(
            SMALL,
            rig=StereoRig(width=270, height=270, focal=375.0, baseline=0.2),
            matching=MatchingSettings(num_disparities=48, block_size=9),
            depth=DepthSettings(far=far, stride=1),
            placement=Placement(radius=(3.0, 3.0)),
        )
        return scan(
            trimesh.creation.icosphere(subdivisions=3),
            sensor=sensor,
            views=4,
            view_layout="jitter",
            seed=2,
            crop="none",
            num_points=200,
            renderer=renderer,
            keep_images=True,
        )

    nearest = [np.nanmin(i.true_depth) for i in scanned_to(6.0).images]
    limit = float(np.mean([sorted(nearest)[1], sorted(nearest)[2]]))
    found = scanned_to(limit)
    reached = [bool(n < limit) for n in nearest]
    assert sum(reached) == 2
    assert set(found.clean_view.tolist()) == {i for i in range(4) if reached[i]}
    assert set(found.view.tolist()) <= {i for i in range(4) if reached[i]}
    for view, sees in zip(found.views, reached, strict=True):
        assert (view.object_pixels > 0) is sees
        if not sees:
            assert set(dataclasses.asdict(view).values()) == {0, None}


def test_equal_seeds_scan_alike_and_image_noise_changes_the_cloud(fresh_renderer):
    grainy = dataclasses.replace(SMALL, exposure=ExposureSettings(noise=6.0))
    first, again, other, clear = (
        scan(asymmetric(), sensor=s, views=1, seed=seed, num_points=256, renderer=fresh_renderer)
        for s, seed in ((grainy, 3), (grainy, 3), (grainy, 4), (SMALL, 3))
    )
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.clean, again.clean)
    assert first.yaw == again.yaw != other.yaw
    assert first.views[0].disparity_sigma > 1.1 * clear.views[0].disparity_sigma


def test_views_that_are_matched_side_by_side_have_the_bits_of_one_after_another(
    renderer, monkeypatch
):
    grainy = dataclasses.replace(SMALL, exposure=ExposureSettings(noise=6.0))
    matched = []

    def noted(*pair):
        matched.append(threading.get_ident())
        return match(*pair)

    monkeypatch.setattr("qs3.sensor.view.match", noted)
    clouds = []
    for threads in ("1", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        options = {"sensor": grainy, "views": 3, "seed": 3, "num_points": 256, "renderer": renderer}
        clouds.append(scan(asymmetric(), **options).points)
    np.testing.assert_array_equal(*clouds)
    assert len(matched) == 6
    assert len(set(matched[:3])) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": DepthSettings(near=5.9)}, "saw no point"),
        # Smaller than a pixel.
        ({"object_size": 1e-3}, "saw no point.*0.001 large.* 3 to 5 away; set distance"),
        # So few points show no shape.
        ({"object_size": 0.06}, r"saw \d+ points? of the object"),
        ({"object_size": 0.0}, "object_size"),
        ({"object_size": float("nan")}, "object_size"),
    ],
)
def test_invisible_objects_are_refused(change, message, renderer):
    with pytest.raises(InputError, match=message):
        scan(asymmetric(), sensor=dataclasses.replace(SMALL, **change), views=1, renderer=renderer)


def test_a_mesh_may_be_a_file_or_a_built_in_class(tmp_path, renderer):
    asymmetric().export(tmp_path / "part.stl")
    settings = {"sensor": SMALL, "views": 1, "num_points": 64, "renderer": renderer}
    clouds = [scan(mesh, **settings).points for mesh in (asymmetric(), tmp_path / "part.stl")]
    np.testing.assert_allclose(*clouds, atol=1e-5)
    chair = scan("chair", seed=2, **settings).mesh
    assert chair.faces.shape == shapes.make("chair", seed=2).faces.shape
    with pytest.raises(InputError, match="neither a mesh file nor a built-in class"):
        scan("chairs", **settings)


def test_few_points_are_reported_with_size_distance_and_remedy(renderer, caplog):
    TOLD.clear()
    for size, lines in ((1.0, 0), (0.1, 1), (0.13, 1)):
        result = scan(
            asymmetric(), sensor=SMALL, object_size=size, views=1, num_points=512, renderer=renderer
        )
        assert (4 * result.fused_points < 512) == bool(lines)
        assert len(caplog.messages) == lines
    (line,) = caplog.messages
    assert "num_points 512" in line
    assert "about 0.1 large and is seen from 3 to 5 away; set distance" in line


def test_wrong_matches_within_the_gate_make_no_cloud_of_an_object_beyond_it(renderer):
    # At a distance of 6.5 every point of it is farther than 5.8; what falls within 5.7 is wrong.
    far = dataclasses.replace(
        SMALL, placement=Placement(radius=(6.5, 6.5)), exposure=ExposureSettings(noise=4.0)
    )
    far = dataclasses.replace(far, depth=DepthSettings(near=1.0, far=5.7, stride=1))
    with pytest.raises(InputError, match="saw no point"):
        scan(asymmetric(), sensor=far, views=2, crop="none", renderer=renderer)


def test_a_caster_of_several_bodies_returns_the_front_one():
    rig = StereoRig(width=9, height=3, focal=4.0)
    pose = Pose(np.eye(4))
    near = trimesh.creation.box(extents=[1.1, 1.1, 0.5]).apply_translation([0, 0, 2.25])
    far = trimesh.creation.box(extents=[9, 9, 0.5]).apply_translation([0, 0, 4.25])
    cast = DepthCaster(far, near).cast(rig, pose, rig.full_frame, normals=True)
    assert cast.body[1].tolist() == [0, 0, 0, 1, 1, 1, 0, 0, 0]
    np.testing.assert_array_equal(cast.depth[1], np.where(cast.body[1] == 1, 2.0, 4.0))
    np.testing.assert_array_equal(cast.mask, cast.body == 0)
    np.testing.assert_allclose(cast.normals, np.broadcast_to([0.0, 0, -1], (3, 9, 3)), atol=1e-12)
    alone = DepthCaster(near).cast(rig, pose, rig.full_frame)
    np.testing.assert_array_equal(alone.mask, cast.body == 1)
    assert (alone.body[~alone.mask] == -1).all()


def test_the_renderer_is_asked_for_no_more_than_is_matched(renderer):
    rendered = []

    def render(scene, rig, poses, seeds, regions=None):
        rendered.append(regions)
        return renderer.render(scene, rig, poses, seeds, regions)

    watching = SimpleNamespace(description=renderer.description, render=render)
    small = dataclasses.replace(
        SMALL,
        rig=StereoRig(width=270, height=270, focal=375.0, baseline=0.2),
        matching=MatchingSettings(num_disparities=48, block_size=9),
    )
    options = {"sensor": small, "views": 1, "seed": 3, "num_points": 100, "renderer": watching}
    part = scan(asymmetric(), scene="room", keep_images=True, **options)
    whole = scan(asymmetric(), scene="room", full_frames=True, **options)
    scan(asymmetric(), **options)
    assert rendered[0][0].width < 270
    assert rendered[1:] == [[small.rig.full_frame], None]
    # The part holds what the whole frame holds there, up to the renderer's own noise.
    inner = part.images[0].region.slices
    np.testing.assert_array_equal(whole.images[0].true_depth[inner], part.images[0].true_depth)
    np.testing.assert_array_equal(whole.images[0].mask[inner], part.images[0].mask)
    differ = whole.images[0].left[inner].astype(float) - part.images[0].left
    assert abs(differ.mean()) < 0.5
    assert whole.views[0].disparity_sigma == pytest.approx(part.views[0].disparity_sigma, rel=0.2)


def test_a_resting_part_is_scanned_as_it_lies():
    """Seed by seed, the cloud and the returned mesh agree, and upright scans draw nothing."""
    rod = trimesh.creation.cylinder(0.1, 1.0)
    heights = set()
    for seed in range(4):
        lying = scan(rod, sensor=SMALL, seed=seed, views=1, pose="resting", num_points=128)
        assert np.asarray(lying.mesh.bounds).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)
        assert lying.drawn["pose"] in (0, 1)
        heights.add(round(float(lying.mesh.extents[2]), 1))
        assert np.abs(trimesh.proximity.signed_distance(lying.mesh, lying.clean)).max() < 0.05
    assert heights == {0.2}
    assert "pose" not in scan(rod, sensor=SMALL, views=1, num_points=128).drawn


def test_points_near_the_table_go_as_from_scans_of_which_a_table_was_cut(renderer):
    """The same points without the low ones; pairs stay pairs, and half of the points stay."""
    options = {"sensor": SMALL, "views": 2, "seed": 4, "num_points": 40_000, "sampling": "random"}
    options |= {"renderer": renderer, "crop": "mask"}
    whole = scan(asymmetric(), **options)
    lowest, heights = whole.mesh.bounds[0, 2], set()
    for seed in range(3):
        options["seed"] = seed
        every, kept = (
            scan(asymmetric(), **options),
            scan(asymmetric(), table_cut=(0.05, 0.1), **options),
        )
        cut = kept.drawn["table_cut"]
        heights.add(cut)
        assert 0.05 <= cut <= 0.1 and "table_cut" not in every.drawn
        assert kept.drawn["table"] == pytest.approx(lowest)
        assert "table" not in every.drawn and "camera" not in kept.drawn  # two views
        above = every.points[:, 2] > lowest + cut
        assert 0.1 < above.mean() < 0.95
        pairs = ({*map(bytes, np.hstack([one.points, one.clean])[rows])} for one, rows in
                 ((every, above), (kept, slice(None))))  # fmt: skip
        assert next(pairs) == next(pairs)
    assert len(heights) == 3
    one = scan(asymmetric(), table_cut=(0.0, 0.1), **options | {"views": 1})
    camera, away = np.array(one.drawn["camera"]), one.poses[0].camera_to_world[:3, 3]
    assert np.linalg.norm(camera) == pytest.approx(np.linalg.norm(away))
    sights = camera - one.clean
    _, _, faces = trimesh.proximity.closest_point(one.mesh, one.clean)
    assert (np.einsum("ij,ij->i", one.mesh.face_normals[faces], sights) > 0).mean() > 0.95
    none = scan(asymmetric(), table_cut=(0.0, 0.0), **options)
    assert none.points.tobytes() == every.points.tobytes()
    high = scan(asymmetric(), table_cut=(5.0, 9.0), **options)
    assert high.drawn["table_cut"] == pytest.approx(
        np.median(every.points[:, 2]) - lowest, abs=1e-3
    )
    assert len(high.points) == pytest.approx(len(every.points) / 2, rel=0.01)


def test_a_scan_on_a_grid_keeps_the_pixels_of_one_point_per_cell(renderer):
    options = {"sensor": SMALL, "views": 2, "seed": 4, "num_points": 40_000, "sampling": "random"}
    options |= {"renderer": renderer, "crop": "mask"}
    every, thinned = scan(asymmetric(), **options), scan(asymmetric(), grid=0.05, **options)
    assert grid_edge([thinned.points]) == pytest.approx(0.05, rel=1e-3)
    assert 12 < len(thinned.points) < len(every.points) / 2
    assert thinned.fused_points == every.fused_points
    assert len(thinned.view) == len(thinned.points) and len(thinned.clean_view) == len(
        thinned.clean
    )
    rows = {bytes(row): number for number, row in enumerate(every.clean)}
    of_made = [rows[bytes(row)] for row in thinned.clean]
    off = every.points[of_made] - thinned.points[: len(of_made)]
    assert np.linalg.norm(off, axis=1).max() <= 0.025 * 3**0.5 + 1e-6
    with pytest.raises(InputError, match="grid 5 leaves 1 points"):
        scan(asymmetric(), grid=5.0, **options)


@pytest.mark.parametrize("cut", [(-0.001, 0.01), (0.02, 0.01), (0.0, np.inf), (np.nan, 0.01)])
def test_a_cut_of_no_heights_is_refused(cut):
    with pytest.raises(InputError, match="table_cut"):
        ScanSettings(table_cut=cut)


@pytest.mark.parametrize("block", [9, 19, 41, 61])
def test_the_part_that_is_matched_holds_all_that_a_block_widens_edges_by(block):
    matching = dataclasses.replace(SMALL.matching, block_size=block)
    settings = ScanSettings(sensor=dataclasses.replace(SMALL, matching=matching), views=2)
    (staged,) = stages(asymmetric(), settings, Streams.of(3))
    for part, pose in zip(staged.parts, staged.poses, strict=True):
        rig = staged.sensor.rig
        tight = rig.region_of(staged.bounds, pose, 0).bounds
        first = [max(0, place - block // 2) for place in tight[:2]]
        last = [
            min(s, at + block // 2)
            for s, at in zip((rig.width, rig.height), tight[2:], strict=True)
        ]
        assert part.bounds[0] <= first[0] and part.bounds[1] <= first[1]
        assert part.bounds[2] >= last[0] and part.bounds[3] >= last[1]
