"""Laws of ad-census matching, on pictures of spots whose shift is known, and on a real pair."""

import dataclasses
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from qs3.errors import QS3Error
from qs3.sensor.matching import match, matching_canvas
from qs3.sensor.matching.ad_census import agreeing
from qs3.sensor.presets import SENSORS
from qs3.sensor.rig import Region, StereoRig

# Those of the D4xx, with a shorter search.
SETTINGS = dataclasses.replace(SENSORS["d435"].matching, num_disparities=64)


def layer(shape, shift, seed, ambient):
    """Spots of a projector and a faint texture on one surface, from left and right.

    ``shift`` is a number or a function of column and row in the left image.
    """
    rng = np.random.default_rng(seed)
    height, width = shape
    images = [np.full((height + 40, width + 40), float(ambient)) for _ in range(2)]
    around = np.arange(-7, 8)
    for density, sigma, low, high in ((1 / 86, 1.1, 54, 90), (0.03, 2.0, -4, 4)):
        count = int(density * height * (width + 120))
        rows, columns = rng.uniform(-4, height + 4, count), rng.uniform(-20, width + 100, count)
        bright = rng.uniform(low, high, count)
        moved = columns - (shift(columns, rows) if callable(shift) else shift)
        for image, places in zip(images, (columns, moved), strict=True):
            seen = (places > -12) & (places < width + 12)
            y, x = np.rint(rows[seen]).astype(int), np.rint(places[seen]).astype(int)
            down = np.exp(-((y[:, None] + around - rows[seen, None]) ** 2) / (2 * sigma**2))
            across = np.exp(-((x[:, None] + around - places[seen, None]) ** 2) / (2 * sigma**2))
            at = y[:, None, None] + around[:, None] + 20, x[:, None, None] + around + 20
            np.add.at(image, at, bright[seen, None, None] * down[:, :, None] * across[:, None, :])
    return [image[20 : 20 + height, 20 : 20 + width] for image in images]


def pair(shape, far, bar=None, seed=0, noise=1.0):
    """A wall, and before it a brighter bar: its first column, the one after its last, its shift."""
    images = layer(shape, far, seed, 45)
    if bar is not None:
        first, last, near = bar
        columns = np.arange(shape[1])
        for index, image in enumerate(layer(shape, near, seed + 100, 70)):
            start, stop = first - index * near, last - index * near
            cover = np.minimum(columns + 1, stop) - np.maximum(columns, start)
            images[index] += (image - images[index]) * cover.clip(0, 1)
    rng = np.random.default_rng(seed + 1)
    noisy = (image + noise * rng.standard_normal(shape) for image in images)
    return tuple(np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in noisy)


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_a_facing_wall_is_filled_unbiased_and_not_locked_to_whole_pixels(noise):
    means, errors = [], []
    for index, shift in enumerate(np.arange(20, 21, 1 / 8)):
        disparity = match(*pair((70, 200), shift, seed=7 + index, noise=noise), SETTINGS)
        error = (disparity - shift)[10:-10, 50:-10]
        assert np.isfinite(error).mean() > 0.995
        assert (np.abs(error) > 1).mean() < 0.001
        means.append(np.nanmean(error))
        errors.append(np.nanmean(error**2))
    assert abs(np.mean(means)) < 0.01
    assert np.ptp(means) / 2 < 0.03  # of the V through the same costs: 0.25
    assert np.sqrt(np.mean(errors)) < (0.04 if noise == 1 else 0.08)


def test_a_slanted_wall_has_no_layers_and_smooth_noise():
    slope = 0.04

    def shift(u, v):
        return 14 + slope * u + 0.01 * v

    disparity = match(*pair((120, 380), shift, noise=3.0), SETTINGS)[12:-12, 60:-40]
    v, u = np.mgrid[12 : 12 + disparity.shape[0], 60 : 60 + disparity.shape[1]]
    error = disparity - shift(u, v)
    assert np.isfinite(error).mean() > 0.99
    assert np.nanstd(error) < 0.08
    fraction = [np.nanmean(error[(shift(u, v) % 1 * 8).astype(int) == k]) for k in range(8)]
    assert np.ptp(fraction) / 2 < 0.03
    count, _ = np.histogram(disparity % 1, bins=16, range=(0, 1))
    known, _ = np.histogram(shift(u, v) % 1, bins=16, range=(0, 1))
    assert (count / known).min() > 0.8
    assert (count / known).max() < 1.25
    part = np.nan_to_num(error - np.nanmean(error))
    along = [(part[:, k:] * part[:, :-k]).mean() / (part**2).mean() for k in (1, 8, 24)]
    assert along[0] > 0.75
    assert 0.2 < along[1] < 0.8
    assert abs(along[2]) < 0.25


@pytest.mark.parametrize("step", [5, 10, 25])
def test_edges_are_sharp_and_the_band_behind_them_empty(step):
    first, last, far = 130, 200, 12.3
    disparity = match(*pair((130, 300), far, (first, last, far + step), seed=step), SETTINGS)
    rows = disparity[12:-12]
    near = np.abs(rows - far - step) < 1
    inside = near[:, first + 4 : last - 4]
    assert inside.mean() > 0.97
    near[:, : first - 40] = near[:, last + 40 :] = False
    left = first - near.argmax(axis=1)
    right = near.shape[1] - near[:, ::-1].argmax(axis=1) - last
    for spill in (left, right):
        assert abs(np.median(spill)) <= 2.5
        assert np.percentile(spill, 90) <= 5
    wall = np.abs(rows[:, :first] - far) < 1
    band = wall[:, ::-1].argmax(axis=1)
    assert abs(np.median(band) - step) <= 2
    visible = np.r_[15 : first - step - 4, last + 4 : 298]
    assert np.isfinite(rows[:, visible]).mean() > 0.99
    # No depth lies between the two surfaces.
    between = (rows > far + 1) & (rows < far + step - 1)
    assert between.mean() < 0.001


@pytest.mark.parametrize(("width", "least"), [(3, 0.6), (5, 0.95), (8, 0.95), (12, 0.95)])
def test_thin_bars_are_told_as_wide_as_they_are(width, least):
    disparity = match(*pair((130, 300), 12.3, (150, 150 + width, 27.6), seed=width), SETTINGS)
    near = np.abs(disparity[12:-12] - 27.6) < 1
    assert near[:, 150 : 150 + width].any(axis=1).mean() >= least
    assert abs(np.median(near[:, 130 : 180 + width].sum(axis=1)) - width) <= 2


@pytest.mark.parametrize("method", ["ad-census", "zncc"])
def test_same_bytes_beside_other_threads(method):
    images, settings = pair((70, 200), 20.3), dataclasses.replace(SETTINGS, method=method)
    wanted = match(*images, settings)
    assert 0.2 < np.isfinite(wanted).mean() < 1
    with ThreadPoolExecutor(3) as pool:
        for disparity in pool.map(lambda _: match(*images, settings), range(3)):
            assert disparity.tobytes() == wanted.tobytes()


def test_ten_bits_of_the_same_levels_give_the_same_depth():
    left, right = pair((70, 200), 20.3)
    eight = match(left, right, SETTINGS)
    ten = match(left.astype(np.uint16) * 4, right.astype(np.uint16) * 4, SETTINGS)
    assert (np.isfinite(eight) == np.isfinite(ten)).mean() > 0.995
    assert np.nanpercentile(np.abs(eight - ten), 99) <= 2 / 32


def test_where_nothing_can_be_told_apart_nothing_is_told():
    flat = np.full((60, 160), 90, np.uint8)
    assert np.isnan(match(flat, flat, SETTINGS)).all()
    stripes = np.repeat(np.arange(60, dtype=np.uint8)[:, None] * 4, 160, axis=1)
    assert np.isnan(match(stripes, stripes, SETTINGS)).all()


def test_the_second_peak_refuses_what_is_hardly_better_than_another():
    images, shares = pair((70, 200), 20.3, noise=8.0), []
    for least in (0.0, 0.8, 1.6, 20.0):
        census = dataclasses.replace(SETTINGS.ad_census, second_peak=least)
        disparity = match(*images, dataclasses.replace(SETTINGS, ad_census=census))
        shares.append(np.isfinite(disparity).mean())
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > shares[2] > shares[3] == 0


def test_fractions_without_corrections_are_a_v_through_the_costs():
    census = dataclasses.replace(SETTINGS.ad_census, corrections=0)
    plain = dataclasses.replace(SETTINGS, ad_census=census)
    error = match(*pair((70, 220), 20.25), plain)[10:-10, 50:-10] - 20.25
    assert np.isfinite(error).mean() > 0.99
    assert -0.3 < np.nanmean(error) < -0.1  # towards the whole pixel


def test_a_region_matches_nearly_as_the_whole_frame():
    # Not bit for bit: scanlines run over all that is known.
    left, right = pair((130, 360), 12.3, (190, 240, 27.6))
    rig = StereoRig(width=360, height=130, focal=500.0)
    whole = match(left, right, SETTINGS)
    region = Region(170, 40, 90, 50)
    canvas = matching_canvas(region, rig, SETTINGS)
    part = match(left[canvas.slices], right[canvas.slices], SETTINGS)
    y, x = region.y - canvas.y, region.x - canvas.x
    inner, wanted = part[y : y + 50, x : x + 90], whole[region.slices]
    assert (np.isfinite(inner) == np.isfinite(wanted)).mean() > 0.995
    assert np.nanpercentile(np.abs(inner - wanted), 99) <= 2 / 32


def test_the_search_from_the_right_has_the_whole_range_on_the_right_too():
    """A wall that begins where the region ends: the mirrored search looks for it there."""
    rig, shape = StereoRig(width=420, height=90, focal=500.0), (90, 420)
    left, right = pair(shape, 8, bar=(250, 330, 40), seed=4)
    region = Region(150, 20, 60, 50)
    whole = match(left, right, SETTINGS)[region.slices]
    canvas = matching_canvas(region, rig, SETTINGS)
    assert canvas.bounds[2] >= region.bounds[2] + SETTINGS.num_disparities
    one_way = dataclasses.replace(SETTINGS, left_right=0.0)
    assert matching_canvas(region, rig, one_way).bounds[2] < canvas.bounds[2]
    part = match(left[canvas.slices], right[canvas.slices], SETTINGS)
    inner = part[region.within(canvas)]
    assert (np.isfinite(inner) == np.isfinite(whole)).mean() > 0.995


def test_what_the_right_image_is_unsure_of_stays_and_what_it_denies_goes():
    far, near, period = 5, 12, 9
    best = np.full((1, 60), far, np.int32)
    best[0, 30:40] = near
    back = np.full((1, 60), far, np.int32)
    back[0, 18:28] = near  # what the right image shows of the bar
    wanted = np.ones(best.shape, dtype=bool)
    kept = agreeing(wanted, best, back, 1.0)[0]
    # Seven columns left of the bar are seen from the left only.
    assert np.flatnonzero(~kept).tolist() == [23, 24, 25, 26, 27, 28, 29]
    back[0, 40:50] = far + period  # the right image sees the pattern one period further
    best[0, 15] = far + period  # and the left one, in a pixel
    kept = agreeing(wanted, best, back, 1.0)[0]
    assert kept[45:55].all()
    assert not kept[15]


def test_a_perforated_plate_is_filled():
    """Holes of 8 px, 12 px apart, under spots that hardly add to the mean level, and noise."""
    spots = (image.astype(float) for image in pair((130, 400), 20.3, noise=0.0))
    v, u = np.mgrid[:130, :400]
    rng, images = np.random.default_rng(0), []
    for image, shift in zip(spots, (0.0, 20.3), strict=True):
        hole = ((u + shift) % 12 - 6) ** 2 + (v % 12 - 6) ** 2 < 4**2
        level = np.where(hole, 25, 110) + 0.05 * (image - image.mean())
        images.append(np.rint(level + 2 * rng.normal(size=level.shape)).astype(np.uint8))
    error = np.abs(match(*images, SETTINGS) - 20.3)[10:-10, 50:-10]
    assert np.isfinite(error).mean() > 0.996
    assert np.nanmax(error) < 1


def test_a_machine_that_cannot_compile_gets_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    for name in ("ad_census", "volume", "scanlines", "ad_census_subpixel", "zncc"):
        monkeypatch.delitem(sys.modules, f"qs3.sensor.matching.{name}", raising=False)
    for method in ("ad-census", "zncc"):
        with pytest.raises(QS3Error, match=r"^this machine cannot compile.*constraints.txt$"):
            match(*pair((40, 100), 5.0), dataclasses.replace(SETTINGS, method=method))


@pytest.mark.data
def test_a_real_d435_pair_is_matched_as_the_camera_does(d435_pair):
    left, right, camera = d435_pair
    disparity = match(left, right, dataclasses.replace(SETTINGS, num_disparities=128))
    assert np.isfinite(disparity)[:, 48:].mean() >= 0.98
    error = np.abs(disparity - camera)
    assert (error[np.isfinite(error)] > 3).mean() <= 0.004
    # The box's upper edge and its slanted right edge, outwards from where the picture has them.
    spills = {"ours": ([], []), "camera": ([], [])}
    for name, image in (("ours", disparity), ("camera", camera)):
        for x in range(190, 364, 2):
            edge = round(178.1 - 0.244 * x)
            box, floor = np.nanmedian(image[edge + 4 : edge + 24, x]), image[edge - 60, x]
            near = image[edge - 30 : edge + 8, x] > (box + floor) / 2
            spills[name][0].append(30 - near.argmax())
        for y in range(100, 176, 2):
            edge = round(312.4 + 0.749 * y)
            box = np.nanmedian(image[y, edge - 24 : edge - 4])
            floor = np.nanmedian(image[y, edge + 35 : edge + 50])
            near = image[y, edge - 12 : edge + 34] > (box + floor) / 2
            spills[name][1].append(33 - near[::-1].argmax() - 12 + 1)
    for side, most in enumerate((2, 3)):
        ours, camera_own = (np.nanmedian(spills[name][side]) for name in spills)
        assert abs(ours - camera_own) <= most
    # The bottle, 4 px nearer than the floor beside it.
    extents = []
    for image in (disparity, camera):
        rows = image[44:130]
        floor = np.nanmedian(np.hstack([rows[:, 400:425], rows[:, 520:545]]), axis=1)
        near = rows[:, 425:520] > floor[:, None] + 4
        seen = near.any(axis=1)
        extents.append(
            [np.median(near.argmax(axis=1)[seen]), np.median(near[:, ::-1].argmax(axis=1)[seen])]
        )
    assert np.abs(np.subtract(*extents)).max() <= 3
