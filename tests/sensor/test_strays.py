"""What is measured of a view and of a cloud; strays, and each step that drops them."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from qs3.points.outliers import attached, inliers
from qs3.sensor.depth import DepthSettings
from qs3.sensor.placement import Placement
from qs3.sensor.presets import load_sensor
from qs3.sensor.rig import Pose, StereoRig
from qs3.sensor.statistics import radius_ratio, view_statistics
from qs3.sensor.view import ViewImages, measure

from .laws.faces import ratio_rows


def test_statistics_equal_known_errors():
    rig = StereoRig()
    rng = np.random.default_rng(0)
    depth = np.full((120, 120), np.nan)
    depth[30:90, 30:90] = 3.0
    disparity = np.full((120, 120), np.nan)
    disparity[30:90, 30:90] = 50.0 + 0.1 + 0.2 * rng.standard_normal((60, 60))
    disparity[30:36, 30:90] = np.nan  # a tenth of the object is not matched
    disparity[36:42, 30:60] += 20.0  # a twentieth of it is grossly wrong
    disparity[20:30, 30:90] = 50.0  # one of four sides of the ring is fattened
    measured = view_statistics(disparity, depth, rig)
    assert measured.object_pixels == 3600
    assert measured.valid_fraction == pytest.approx(0.9)
    assert measured.gross_share == pytest.approx(180 / 3240)
    assert measured.disparity_bias == pytest.approx(0.1, abs=0.03)
    assert measured.disparity_sigma == pytest.approx(0.2, rel=0.15)
    assert measured.ring_fraction == pytest.approx(0.22, abs=0.03)


@pytest.mark.parametrize("shape", [(5, 5), (0, 0)])
def test_statistics_of_nothing_are_none(shape):
    empty = np.full(shape, np.nan)
    measured = view_statistics(empty, empty, StereoRig())
    assert measured.object_pixels == 0
    assert measured.valid_fraction is None
    assert measured.disparity_sigma is None
    assert measured.ring_fraction is None


def sphere(count, rng):
    points = rng.standard_normal((count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_the_radius_ratio_is_a_shapes_own_and_one_stray_shrinks_it():
    rng = np.random.default_rng(0)
    ball = sphere(20_000, rng) * rng.random((20_000, 1)) ** (1 / 3)
    ratio = radius_ratio(ball)
    assert ratio == pytest.approx(0.9 ** (1 / 3), abs=0.01)
    assert radius_ratio(7 * ball + [1.0, -2.0, 3.0]) == pytest.approx(ratio, abs=1e-9)
    strayed = np.concatenate([ball, [[0.0, 10.0, 0.0]]])
    assert radius_ratio(strayed) == pytest.approx(ratio / 10, rel=0.02)
    assert radius_ratio(np.ones((5, 3))) == 1.0


def reference(points):
    """The same by all distances, point by point."""
    kept = list(range(len(points)))
    for _ in range(2):
        far = np.sort(cdist(points[kept], points[kept]), axis=1)[:, 1:17].mean(axis=1)
        bound = np.median(far) + 3 * 1.4826 * np.median(np.abs(far - np.median(far)))
        kept = [index for index, mean in zip(kept, far, strict=True) if mean <= bound]
    radius = np.linalg.norm(points[kept] - np.median(points[kept], axis=0), axis=1)
    return [index for index, r in zip(kept, radius, strict=True) if r <= 3 * np.median(radius)]


def test_outliers_go_and_the_surface_stays():
    rng = np.random.default_rng(1)
    surface = sphere(1500, rng)
    clump = np.array([0.0, 6.0, 0.0]) + 0.05 * rng.standard_normal((40, 3))
    cloud = np.concatenate([surface, rng.uniform(2, 5, (30, 3)), clump])
    kept = inliers(cloud)
    assert kept[:1500].mean() > 0.95
    assert not kept[1500:].any()  # the clump is as dense as the surface: its radius tells it
    assert np.flatnonzero(kept).tolist() == reference(cloud)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 17])
def test_a_cloud_of_few_points_is_taken(count):
    assert inliers(sphere(count, np.random.default_rng(2))).shape == (count,)


def test_the_crop_with_the_mask_ends_a_margin_and_noise_off_the_true_surface():
    rig = StereoRig(width=8, height=2, focal=10.0, baseline=12.0)  # noise z²/400 thrice
    depth, far = DepthSettings(far=100.0, stride=1), Placement(radius=(20.0, 21.0))  # in 8 px
    sensor = dataclasses.replace(load_sensor("d435"), rig=rig, depth=depth, placement=far)
    true = np.tile([1.5, 1.5, 1.5, 2.0, 2.0, 4.0, 4.0, 4.0], (2, 1))
    off = np.array([0.105, -0.105, 0.106, 0.109, -0.111, 0.139, 0.141, np.nan])
    depth = true + off
    mask = np.array([[True] * 8, [False] * 8])
    grey = np.zeros(true.shape, np.uint8)
    view = ViewImages(rig.full_frame, grey, grey, depth.astype(np.float32), depth, true, mask)

    def found(margin):
        cloud, clean, _ = measure(view, rig.full_frame, Pose(np.eye(4)), sensor, margin)
        places = [depth[0].round(6).tolist().index(z) for z in cloud[:, 2].round(6)]
        twins = true[0, places]
        twins[7:] = np.nan  # of the row that does not show the object
        np.testing.assert_allclose(clean[:, 2], twins)
        return cloud[:, 2].round(6).tolist()

    assert found(0.1) == [1.605, 1.395, 2.109, 4.139]
    assert found(0.0) == []
    assert found(10.0) == depth[0, :7].round(6).tolist()
    assert found(None) == [*found(10.0), *found(10.0)]


# The law T11


def test_t11_wants_real_scans_ratios():
    clean = np.linspace(0.6, 0.9, 40).tolist()
    assert all(figure["passed"] for figure in ratio_rows(clean))
    strayed = [0.3, 0.3, 0.3, *clean[3:]]  # the 5 % quantile alone
    assert [figure["passed"] for figure in ratio_rows(strayed)] == [False, True, True]
    assert not any(figure["passed"] for figure in ratio_rows([ratio / 2 for ratio in clean]))


def pixels(wide: int, high: int, left: float = 0, low: float = 0, away: float = 0) -> np.ndarray:
    """A face of one millimetre a pixel, with the noise of a depth camera."""
    x, y = np.mgrid[:wide, :high].reshape(2, -1) + np.array([[left], [low]])
    noise = np.random.default_rng(wide + high).normal(scale=0.3, size=x.size)
    return 1e-3 * np.column_stack([x, y, away + noise])


PLATE = pixels(60, 40)
THIN = {
    "a plate": PLATE,
    "a pin of two pixels": np.vstack([PLATE, pixels(2, 60, left=20, low=40)]),
    "a wire of one pixel": np.vstack([PLATE, pixels(1, 80, left=20, low=40)]),
    "a rod alone": pixels(3, 90),
    "a frame": np.vstack([pixels(60, 2), pixels(60, 2, low=50), pixels(2, 48, low=2)]),
    "two arms": np.vstack([PLATE, pixels(3, 40, 0, 40), pixels(3, 40, 57, 40)]),
    "a second face behind a gap": np.vstack([PLATE, pixels(40, 10, low=50, away=30)]),
    "a steep side": np.vstack([PLATE, pixels(60, 10) @ np.diag([1, 2, 0]) + [0, 0.04, 0.03]]),
}


@pytest.mark.parametrize("name", THIN)
@pytest.mark.parametrize("turned", [False, True])
def test_a_wall_far_behind_a_part_is_detached(name, turned):
    rng, part = np.random.default_rng(0), THIN[name]
    wall = pixels(20, 8, left=20, away=2000)
    cloud = np.vstack([part, wall])
    if turned:  # order, place and size do not matter
        order = rng.permutation(len(cloud))
        kept = np.empty(len(cloud), dtype=bool)
        kept[order] = attached(7 * cloud[order][:, [2, 0, 1]] + 3)
    else:
        kept = attached(cloud)
    np.testing.assert_array_equal(kept, np.arange(len(cloud)) < len(part))


def test_a_rod_seen_at_both_ends_alone_keeps_both():
    ends = np.vstack([pixels(12, 12), pixels(12, 8, left=70)])
    assert attached(ends).all()


@pytest.mark.parametrize("count", [0, 1, 3, 8, 9, 20, 31])
def test_few_points_are_not_detached(count):
    points = np.random.default_rng(0).random((count, 3))
    points[count // 2 + 1 :] += 100
    assert attached(points).all()
