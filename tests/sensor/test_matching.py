import dataclasses
from typing import get_args

import numpy as np
import pytest
from scipy import ndimage

from qs3.errors import InputError
from qs3.sensor.matching import MatchingSettings, match, matching_canvas
from qs3.sensor.matching.filters import drop_small_regions, median_of_valid
from qs3.sensor.matching.settings import Method
from qs3.sensor.rig import Region, StereoRig

ZNCC = MatchingSettings("zncc", num_disparities=64, block_size=15, left_band="physical")
PLAIN = dataclasses.replace(ZNCC, left_right=0.0, uniqueness=0.0, correlation=0.0, texture=0.0)
BM = MatchingSettings(num_disparities=64, block_size=15)


def dots(shift, shape=(120, 300), density=0.025, noise=0.0, seed=0, sigma=0.8, white=255):
    """Gaussian dots at random places, and the same moved left; ``shift`` may be one per dot row."""
    rng = np.random.default_rng(seed)
    height, width = shape
    count = int(density * height * (width + 64))
    rows, columns = rng.uniform(0, height, count), rng.uniform(0, width + 64, count)
    bright = rng.uniform(100, 160, count)
    around = np.arange(-4, 5)
    images = []
    for centre in (columns, columns - shift):
        image = np.full((height + 10, width + 74), 40.0)
        y, x = np.rint(rows).astype(int), np.rint(centre).astype(int)
        across = np.exp(-((x[:, None] + around - centre[:, None]) ** 2) / (2 * sigma**2))
        down = np.exp(-((y[:, None] + around - rows[:, None]) ** 2) / (2 * sigma**2))
        spot = bright[:, None, None] * down[:, :, None] * across[:, None, :]
        at_y = np.clip(y[:, None, None] + around[:, None] + 5, 0, height + 9)
        at_x = np.clip(x[:, None, None] + around + 5, 0, width + 73)
        np.add.at(image, (at_y, at_x), spot)
        image = image[5 : 5 + height, 5 : 5 + width]
        image = (image + noise * rng.standard_normal(image.shape)) * white / 255
        images.append(np.clip(np.rint(image), 0, white).astype(np.uint16))
    return tuple(image.astype(np.uint8) for image in images) if white == 255 else tuple(images)


def noise_pair(shape=(40, 110), seed=3):
    """Rough pictures that match only in part: many correlations near each other."""
    rng = np.random.default_rng(seed)
    left = ndimage.gaussian_filter(rng.standard_normal(shape), 1)
    right = np.roll(left, -7, axis=1) + 0.3 * ndimage.gaussian_filter(rng.standard_normal(shape), 1)
    return tuple(np.clip(128 + 150 * image, 0, 255).astype(np.uint8) for image in (left, right))


def measured(settings, noise):
    """Total RMS of errors below 1 px, bias, and share of grosser ones."""
    errors = []
    for shift in np.arange(20, 21, 1 / 8):
        disparity = match(*dots(shift, shape=(100, 260), noise=noise), settings)
        errors.append((disparity - shift)[20:-20, 90:-20])
    error = np.array(errors)
    error = error[np.isfinite(error)]
    near = error[np.abs(error) < 1]
    return np.sqrt((near**2).mean()), near.mean(), (np.abs(error) >= 1).mean(), error.size


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_zncc_is_unbiased_and_halves_the_error_of_block_matching(noise):
    # reference: StereoBM-15 has 0.08 to 0.11 px and a bias of +0.03 px on such dots.
    error, bias, gross, size = measured(ZNCC, noise)
    block, block_bias, _, block_size = measured(BM, noise)
    assert error <= 0.06
    assert abs(bias) < 0.01
    assert gross < 0.001
    assert size > 0.98 * block_size
    assert 0.07 < block < 0.13
    assert error < 0.65 * block
    assert block_bias == pytest.approx(0.03, abs=0.01)


def reference_zncc(left, right, settings):
    """Pixel by pixel with `np.corrcoef` over the pixels that exist in both images."""
    height, width = left.shape
    half = settings.block_size // 2
    cost = np.full((settings.num_disparities, height, width), np.nan)
    for y in range(height):
        rows = slice(max(0, y - half), y + half + 1)
        for u in range(width):
            for d in range(min(settings.num_disparities, u + 2)):
                low, high = max(u - half, d), min(u + half + 1, width)
                a, b = left[rows, low:high], right[rows, low - d : high - d]
                cost[d, y, u] = np.corrcoef(a.ravel(), b.ravel())[0, 1]
    best = np.nanargmax(cost, axis=0)
    disparity = np.full((height, width), np.nan)
    for y, u in np.ndindex(height, width):
        d = best[y, u]
        if 0 < d < settings.num_disparities - 1 and d <= u and cost[d, y, u] > 0:
            c = cost[d - 1 : d + 2, y, u]
            disparity[y, u] = d + (c[2] - c[0]) / (2 * (2 * c[1] - c[0] - c[2]))
    return np.where(disparity <= np.arange(width), disparity, np.nan)


def test_zncc_equals_a_plain_reference_also_at_the_borders():
    left, right = noise_pair((16, 44))
    settings = dataclasses.replace(PLAIN, num_disparities=15, block_size=7)
    expected = reference_zncc(left.astype(float), right.astype(float), settings)
    disparity = match(left, right, settings)
    np.testing.assert_array_equal(np.isnan(disparity), np.isnan(expected))
    np.testing.assert_allclose(disparity, expected, atol=2e-5)
    assert np.isfinite(disparity).mean() > 0.6


def test_ten_bits_are_matched_as_eight():
    left, right = dots(20.4, noise=2.0)
    wide = [image.astype(np.uint16) * 4 for image in (left, right)]
    expected = match(left, right, PLAIN)
    np.testing.assert_allclose(match(*wide, PLAIN), expected, atol=1e-4)
    # A threshold in grey levels of 255 cuts both alike.
    cut = dataclasses.replace(PLAIN, texture=20.0)
    eight, ten = match(left, right, cut), match(*wide, cut)
    assert 0.1 < np.isfinite(eight).mean() < 0.9
    assert (np.isfinite(eight) != np.isfinite(ten)).mean() < 0.01


def test_images_of_the_wrong_kind_are_refused():
    left, right = dots(20.0, shape=(40, 120), white=1023)
    with pytest.raises(InputError, match="8 bits only"):
        match(left, right, BM)
    with pytest.raises(InputError, match="0…1023"):
        match(left + np.uint16(1000), right, ZNCC)
    with pytest.raises(InputError, match="uint16, the right one uint8"):
        match(left, (right // 4).astype(np.uint8), ZNCC)
    with pytest.raises(InputError, match="too small"):
        match(left[:10], right[:10], ZNCC)


@pytest.mark.parametrize("method", get_args(Method))
@pytest.mark.parametrize("shift", [4.4, 40.7])
def test_physical_left_band_is_as_wide_as_the_disparity(method, shift):
    settings = dataclasses.replace(ZNCC, method=method)
    disparity = match(*dots(shift, shape=(160, 260), density=0.05, noise=1.0), settings)
    matched = np.abs(disparity - shift) < 1
    first = np.argmax(matched, axis=1)
    assert abs(np.median(first) - shift) <= 1
    assert np.mean(np.abs(first - shift) <= 2) > 0.9
    # And nothing is made up in the band.
    assert np.isfinite(disparity[:, : int(shift) - 1]).mean() < 0.03
    u = np.arange(disparity.shape[1])
    assert not (disparity > u).any()


@pytest.mark.parametrize("method", get_args(Method))
def test_opencv_left_band_is_as_wide_as_the_search(method):
    settings = dataclasses.replace(ZNCC, method=method, left_band="opencv")
    disparity = match(*dots(20.3), settings)
    assert np.isnan(disparity[:, : 64 + 7 - 1]).all()
    assert np.isfinite(disparity[8:-8, 64 + 7 - 1]).mean() > 0.9


@pytest.mark.parametrize("method", get_args(Method))
def test_disparities_are_exact_multiples_of_the_quantum(method):
    left, right = dots(20.3, shape=(70, 200), noise=2.0)
    median = {} if method == "opencv-bm" else {"median": 3}  # it has none
    free = dataclasses.replace(ZNCC, method=method, **median)
    exact = match(left, right, free)
    for quantum in (1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32):
        rounded = match(left, right, dataclasses.replace(free, quantum=quantum))
        steps = rounded[np.isfinite(rounded)] / quantum
        np.testing.assert_array_equal(steps, np.round(steps))
        assert len(np.unique(steps)) > 1 or quantum > 1 / 8
        assert np.nanmax(np.abs(rounded - exact)) <= quantum / 2
        if method == "opencv-bm" and quantum != 1 / 16:
            biased = dataclasses.replace(free, quantum=quantum, bias_correction=True)
            steps = match(left, right, biased) / quantum
            steps = steps[np.isfinite(steps)]
            np.testing.assert_array_equal(steps, np.round(steps))


def test_unmatched_pixels_are_nan_without_a_warning():
    flat = np.full((60, 160), 90, np.uint8)
    assert np.isnan(match(flat, flat, ZNCC)).all()
    assert np.isnan(match(flat, flat, PLAIN)).all()
    stripes = np.repeat(np.arange(60, dtype=np.uint8)[:, None] * 4, 160, axis=1)
    # Every disparity correlates equally: the smallest wins, at the end of the search.
    assert np.isnan(match(stripes, stripes, PLAIN)[:, 72:]).all()
    assert np.isnan(match(stripes, stripes, ZNCC)).all()
    grain = np.random.default_rng(0).integers(89, 92, (2, 60, 160)).astype(np.uint8)
    assert np.isnan(match(grain[0], grain[1], ZNCC)).all()
    assert np.isfinite(match(grain[0], grain[1], PLAIN)).any()


def test_uniqueness_refuses_a_repeated_pattern():
    left, _ = dots(0.0, shape=(80, 16))
    tiled = np.tile(left, (1, 14))
    right = np.roll(tiled, -8, axis=1)
    loose = dataclasses.replace(ZNCC, uniqueness=0.0, left_right=0.0)
    assert np.isfinite(match(tiled, right, loose)).mean() > 0.8
    unique = dataclasses.replace(ZNCC, left_right=0.0)
    inner = match(tiled, right, unique)[:, 40:-20]
    assert np.isfinite(inner).mean() < 0.01


def step_scene():
    """Disparity 30 on a band of columns before a wall at disparity 10, and its true disparity."""
    far = dots(10.0, shape=(100, 320), density=0.06, seed=1)
    near = dots(30.0, shape=(100, 320), density=0.06, seed=2)
    left, right = far[0].copy(), far[1].copy()
    left[:, 150:220] = near[0][:, 150:220]
    right[:, 120:190] = near[1][:, 120:190]
    truth = np.full(left.shape, 10.0)
    truth[:, 150:220] = 30.0
    return left, right, truth


def test_left_right_check_empties_the_occluded_band():
    left, right, truth = step_scene()
    # Of the wall, left columns 130 to 149 lie behind the box as the right camera sees it.
    hidden = np.s_[10:-10, 132:140]
    loose = dataclasses.replace(ZNCC, left_right=0.0, uniqueness=0.0, correlation=0.2)
    checked = dataclasses.replace(loose, left_right=1.0)
    assert np.isfinite(match(left, right, loose)[hidden]).mean() > 0.6
    agreed = match(left, right, checked)
    assert np.isfinite(agreed[hidden]).mean() < 0.1
    seen = np.s_[10:-10, 235:300]
    assert np.isfinite(agreed[seen]).mean() > 0.95
    assert (np.abs(agreed - truth)[seen] < 0.3).mean() > 0.95
    # Depth edges move by no more than half a block.
    at_edge = agreed[10:-10, 220 + 8 : 235]
    assert np.nanmax(np.abs(at_edge - 10.0)) < 1


@pytest.mark.parametrize("side", [3, 5])
def test_median_takes_only_valid_disparities_and_makes_none_up(side):
    rng = np.random.default_rng(0)
    image = rng.uniform(10, 60, (24, 31)).astype(np.float32)
    image[rng.random(image.shape) < 0.15] = np.nan
    image[:4, :4] = np.nan
    image[1, 1] = 33.0  # alone: its own median
    half = side // 2
    expected = np.full(image.shape, np.nan, np.float32)
    for y, x in np.argwhere(np.isfinite(image)):
        square = image[max(0, y - half) : y + half + 1, max(0, x - half) : x + half + 1]
        valid = np.sort(square[np.isfinite(square)])
        expected[y, x] = valid[(len(valid) - 1) // 2]
    np.testing.assert_array_equal(median_of_valid(image, side), expected)
    assert expected[1, 1] == 33.0 or side == 5


def test_small_regions_are_dropped_whole():
    rng = np.random.default_rng(1)
    disparity = np.where(rng.random((60, 80)) < 0.6, 20.0, np.nan).astype(np.float32)
    disparity[30:, :] += 3.0  # a jump in depth parts regions
    labels = np.zeros(disparity.shape, int)
    labels[:30], count = ndimage.label(np.isfinite(disparity[:30]))
    lower, _ = ndimage.label(np.isfinite(disparity[30:]))
    labels[30:] = np.where(lower > 0, lower + count, 0)
    size = np.bincount(labels.ravel())[labels]
    for least in (0, 1, 2, 7, 40):
        expected = np.where(size >= least, disparity, np.nan)
        np.testing.assert_array_equal(drop_small_regions(disparity, least), expected)
    slope = np.tile(np.arange(40) * 0.9, (3, 1)).astype(np.float32)
    assert np.isfinite(drop_small_regions(slope, 120)).all()
    assert np.isnan(drop_small_regions(slope * 2, 4)).all()


REGIONS = [
    Region(150, 50, 60, 40),
    Region(0, 0, 30, 20),
    Region(260, 90, 40, 30),
    Region(298, 118, 2, 2),
    Region(120, 0, 9, 9),
]
METHODS = {
    "physical-bm": dataclasses.replace(BM, left_band="physical", bias_correction=True),
    "bm": BM,
    "zncc": ZNCC,
    "zncc-one-way": dataclasses.replace(ZNCC, left_right=0.0, block_size=9, quantum=1 / 32),
    "zncc-filtered": dataclasses.replace(ZNCC, median=5, min_region=16, uniqueness=0.15),
    "zncc-opencv-band": dataclasses.replace(
        ZNCC, median=3, min_region=9, left_band="opencv", uniqueness=0.15
    ),
}


@pytest.mark.parametrize("name", METHODS)
def test_region_matching_equals_full_frame_matching_bit_for_bit(name):
    left, right = dots(20.3, noise=25.0)
    settings = METHODS[name]
    rig = StereoRig(width=300, height=120, focal=500.0)
    whole = match(left, right, settings)
    assert 0.05 < np.isnan(whole).mean() < 0.95
    for region in REGIONS:
        canvas = matching_canvas(region, rig, settings)
        part = match(left[canvas.slices], right[canvas.slices], settings)
        y, x = region.y - canvas.y, region.x - canvas.x
        inner = part[y : y + region.height, x : x + region.width]
        np.testing.assert_array_equal(inner, whole[region.slices])


@pytest.mark.parametrize("method", get_args(Method))
def test_convention_disparity_is_positive_for_a_right_image_moved_left(method):
    left, right = dots(25.0)
    settings = dataclasses.replace(ZNCC, method=method)
    assert np.nanmedian(match(left, right, settings)) == pytest.approx(25, abs=0.1)
    swapped = match(right, left, settings)
    assert (np.abs(swapped - 25) < 1).mean() < 0.05  # of the right way round, nearly all
    # ad-census keeps what the right image is unsure of.
    assert np.isfinite(swapped).mean() < (0.5 if method == "ad-census" else 0.25)


def test_block_matching_gives_sixteenths_and_its_correction_takes_off_its_bias():
    plain, corrected = [], []
    unbiased = dataclasses.replace(BM, bias_correction=True)
    for shift in np.arange(20, 21, 1 / 8):
        # New dots each time: the mean over one picture's alone strays by 0.01 px.
        pair = dots(shift, shape=(200, 420), noise=2.0, seed=int(8 * shift))
        rounded = match(*pair, BM)[20:-20, 90:-20]
        steps = rounded[np.isfinite(rounded)] * 16
        np.testing.assert_array_equal(steps, np.round(steps))
        better = match(*pair, unbiased)[20:-20, 90:-20]
        near = np.abs(rounded - shift) < 1
        assert near.mean() > 0.95
        plain.append((rounded - shift)[near].mean())
        corrected.append((better - shift)[near].mean())
    # reference: +0.029 px from rounding up to 1/16 px.
    assert np.mean(plain) == pytest.approx(0.030, abs=0.008)
    assert np.mean(corrected) == pytest.approx(0.0, abs=0.008)
