"""Laws of what is measured on a real pair, on maps whose spill, noise and planes are known."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from qs3.errors import InputError
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.realism.pair import (
    InfraredPair,
    find_edges,
    in_sight,
    planar_patches,
    plane_noise,
    search_range,
    spill,
)

SHAPE = (160, 240)
V, U = np.indices(SHAPE)


def half(degrees, beyond=0.0):
    """Where a near surface is whose edge, ``beyond`` px outwards, passes the middle so turned."""
    angle = np.radians(degrees)
    across = (U - 119.5) * np.cos(angle) + (V - 79.5) * np.sin(angle)
    return across < beyond


def picture(near, rng, contrast=60):
    noisy = 80 + contrast * gaussian_filter(near.astype(float), 0.7) + 3 * rng.normal(size=SHAPE)
    return noisy.round().astype(np.uint8)


@pytest.mark.parametrize("degrees", [0, 25, 70, 90, 155, 180, 270, 300])
@pytest.mark.parametrize("grown", [-2.0, 0.0, 3.0, 12.0])
def test_spill_is_measured_along_the_normal_of_an_edge(degrees, grown, rng):
    near = half(degrees)
    camera = np.where(near, 20.0, 10.0)
    camera[half(degrees, 10.0) & ~near & (np.cos(np.radians(degrees)) < -0.5)] = np.nan  # occluded
    edges = find_edges(picture(near, rng), camera)
    assert len(edges.level) >= 50
    found = spill(np.where(half(degrees, grown), 20.0, 10.0), edges)
    assert np.nanmedian(found) == pytest.approx(grown, abs=0.35)
    assert np.nanmedian(spill(camera, edges)) == pytest.approx(0, abs=0.35)


def test_the_image_tells_where_an_edge_is(rng):
    """Also where the camera's own surface ends 4 px beyond it."""
    camera = np.where(half(0, 4.0), 20.0, 10.0)
    edges = find_edges(picture(half(0), rng), camera)
    assert np.nanmedian(spill(camera, edges)) == pytest.approx(4, abs=0.35)
    assert len(find_edges(picture(half(0), rng, contrast=0), camera).level) < 20
    assert not len(find_edges(picture(half(0), rng), np.where(half(0), 20.0, 17.0)).level)
    spots = 600 * gaussian_filter((rng.random(SHAPE) < 1 / 80).astype(float), 1.4)
    assert len(find_edges((14 + spots).clip(0, 255).astype(np.uint8), camera).level) < 20


def test_strays_and_holes_move_no_edge(rng):
    near = half(0)
    edges = find_edges(picture(near, rng), np.where(near, 20.0, 10.0))
    speckled = np.where(near ^ (rng.random(SHAPE) < 0.1), 20.0, 10.0)
    speckled[rng.random(SHAPE) < 0.2] = np.nan
    found = spill(speckled, edges)
    assert np.nanmedian(found) == pytest.approx(0, abs=0.6)
    assert np.isnan(spill(np.full(SHAPE, np.nan), edges)).all()


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


def test_the_left_band_counts_for_nobody():
    camera = np.full(SHAPE, 12.0)
    camera[:, :30] = np.nan
    camera[5] = np.nan
    seen = in_sight(camera)
    assert seen[:, 12:].all()
    assert not seen[:, :12].any()


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
def test_what_does_not_belong_together_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        pair(**changes)
