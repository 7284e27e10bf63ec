"""Laws of what is measured on a real pair, on maps whose steps, noise and planes are known."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from qs3.errors import InputError
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.realism import (
    InfraredPair,
    in_sight,
    near_steps,
    planar_patches,
    plane_noise,
    search_range,
)

SHAPE = (160, 240)
V, U = np.indices(SHAPE)


def test_steps_are_found_with_what_is_near_them():
    disparity = np.full(SHAPE, 10.0)
    disparity[:, 120:] = 14.5
    disparity[::3] = np.nan
    near = near_steps(disparity)
    assert near[:, 112:128].all()
    assert not near[:, :112].any()
    assert not near[:, 128:].any()
    assert not near_steps(np.where(disparity > 12, 13.5, disparity)).any()


def test_noise_of_planes_is_that_which_was_put_on_them(rng):
    plane = 30 + 0.02 * U - 0.05 * V
    for sigma, smooth in ((0.1, 0.0), (0.1, 3.0)):
        noise = gaussian_filter(rng.normal(size=SHAPE), smooth)
        noisy = plane + sigma * noise / noise.std()
        noisy[::7, ::5] = np.nan
        patches = planar_patches(noisy)
        assert len(patches) == 5 * 4
        rms, along = plane_noise(noisy, patches)
        assert rms == pytest.approx(sigma, rel=0.1)
        expected = np.exp(-(np.array([1, 4, 8]) ** 2) / (4 * smooth**2)) if smooth else np.zeros(3)
        np.testing.assert_allclose(along, expected, atol=0.15)
    assert planar_patches(30 + 3 * np.sin(U / 8)) == []
    assert np.isnan(plane_noise(plane, [])[0])


def test_a_patch_is_a_plane_if_95_of_100_pixels_lie_within_half_a_pixel():
    """One patch of 80 × 60, of which a share of whole columns lies beside the plane."""
    for off, columns, found in ((0.45, 80, [(0, 0)]), (0.55, 3, [(0, 0)]), (0.7, 8, [])):
        disparity = 30 + 0.02 * U[:60, :80] - 0.05 * V[:60, :80]
        rows = np.arange(60)[:, None]
        # Signs that alternate leave the plane where it is.
        disparity[:, :columns] += off * np.where((rows + np.arange(columns)) % 2, 1, -1)
        assert planar_patches(disparity) == found, (off, columns)


def test_the_left_band_counts_for_nobody():
    camera = np.full(SHAPE, 12.0)
    camera[:, :12] = np.nan
    camera[:100, :30] = np.nan
    camera[5] = np.nan
    seen = in_sight(camera)
    assert seen[:, 12:].all()
    assert not seen[:, :12].any()


def test_the_border_outside_the_depth_images_frame_counts_for_nobody():
    whole = np.full(SHAPE, 12.0)
    whole[50:60, 100:120] = np.nan  # a hole, which counts
    camera = np.full(SHAPE, np.nan)
    camera[20:-10, 40:-30] = whole[20:-10, 40:-30]
    camera[2, 50] = camera[80, 5] = 12.0  # strays
    seen = in_sight(camera)
    expected = np.zeros(SHAPE, dtype=bool)
    expected[20:-10, 40:-30] = True
    np.testing.assert_array_equal(seen, expected)
    assert np.isnan(camera)[seen].sum() == 200


def pair(**changes):
    image = np.zeros((240, 640), np.uint8)
    whole = InfraredPair(image, image, np.full((240, 640), 1.0), 600.0, 0.05)
    return dataclasses.replace(whole, **changes)


def test_the_search_reaches_the_nearest_depth_that_the_image_has_room_for():
    settings = MatchingSettings("zncc", 64)
    assert search_range(pair(), settings) == settings
    depth = np.full((240, 640), 1.0)
    depth[:, :64] = 0.2  # 150 px
    assert search_range(pair(depth=depth), settings).num_disparities == 176
    depth[0, 0] = 0.001
    assert search_range(pair(depth=depth), settings).num_disparities == 176
    depth[:, :64] = 0.02
    assert search_range(pair(depth=depth), settings).num_disparities == 608


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"depth": np.full((240, 640), np.nan)}, "no depth at all"),
        ({"depth": np.full((240, 640), 1000.0)}, "depth-scale"),
        ({"baseline": 50.0}, "baseline is in metres"),
        ({"baseline": -0.05}, "baseline"),
        ({"baseline": float("nan")}, "baseline"),
    ],
)
def test_images_that_do_not_belong_together_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        pair(**changes)
