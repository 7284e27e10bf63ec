import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from qs3.errors import InputError
from qs3.sensor.exposure import ExposureSettings, expose
from qs3.sensor.matching import MatchingSettings, match, matching_canvas
from qs3.sensor.rig import Region, StereoRig
from qs3.sensor.speckle import PatternSettings, pattern_image, speckle_pattern
from qs3.sensor.statistics import view_statistics


def speckled_pair(shift: float, shape=(200, 420), seed=0, noise=2.0):
    """A dotted picture and the same moved ``shift`` pixels to the left, from a fine grid."""
    rng = np.random.default_rng(seed)
    scale = 16
    fine = np.zeros((shape[0], (shape[1] + 80) * scale), np.float32)
    rows = rng.integers(0, shape[0], 12000)
    columns = rng.integers(0, fine.shape[1], 12000)
    fine[rows, columns] = 255.0
    fine = cv2.GaussianBlur(fine, (0, 0), sigmaX=0.8 * scale, sigmaY=0.8)
    fine *= 160 / fine.max()

    def sample(offset):
        start = round((32 + offset) * scale)
        cut = fine[:, start : start + shape[1] * scale]
        image = cut.reshape(shape[0], shape[1], scale).mean(axis=2) + 60
        image += noise * rng.standard_normal(shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    return sample(0.0), sample(shift)


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_pattern_has_one_dot_in_nine_and_none_adjacent(seed):
    dots = speckle_pattern(633, 495, seed)
    assert dots.sum() == 633 * 495 // 9
    neighbours = cv2.filter2D(dots.astype(np.float32), -1, np.ones((3, 3), np.float32))
    assert neighbours[dots].max() == 1  # itself alone
    distance = cKDTree(np.argwhere(dots)).query(np.argwhere(dots), 2)[0][:, 1]
    assert distance.min() >= 2
    assert np.median(distance) <= 3


def test_pattern_follows_its_seed():
    np.testing.assert_array_equal(speckle_pattern(30, 30, 4), speckle_pattern(30, 30, 4))
    assert (speckle_pattern(30, 30, 4) != speckle_pattern(30, 30, 5)).any()
    with pytest.raises(InputError, match="multiples of 3"):
        speckle_pattern(31, 30, 0)


def test_a_users_picture_is_projected_and_faults_name_it(tmp_path):
    picture = np.zeros((4, 6), np.uint8)
    picture[0, 5] = 255
    cv2.imwrite(str(tmp_path / "mine.png"), picture)
    image = pattern_image(PatternSettings(image=str(tmp_path / "mine.png")))
    np.testing.assert_array_equal(image, picture / 255)
    (tmp_path / "text.png").write_text("no picture")
    for name in ("text.png", "absent.png"):
        with pytest.raises(InputError, match=name):
            pattern_image(PatternSettings(image=str(tmp_path / name)))


def test_exposure_is_monotone_and_clips():
    light = np.linspace(0, 30, 400)[None]
    for response in ("film", "linear"):
        grey = expose(light, ExposureSettings(response=response)).astype(int)
        assert (np.diff(grey[0]) >= 0).all()
        assert grey[0, 0] == 0
    assert expose(np.array([[5.0]]), ExposureSettings(response="linear"))[0, 0] == 255


def test_image_noise_has_the_size_asked_for():
    draws = np.random.default_rng(0).standard_normal((200, 200))
    settings = ExposureSettings(response="linear", noise=3.0)
    grey = expose(np.full((200, 200), 0.5), settings, draws)
    assert grey.std() == pytest.approx(np.hypot(3.0, 1 / np.sqrt(12)), rel=0.02)
    with pytest.raises(ValueError, match="noise"):
        expose(np.full((2, 2), 0.5), settings)


def test_matching_finds_known_shifts_with_the_known_bias():
    # reference/sensors: StereoBM's mean bias is +0.029 px on dots of known shift, from rounding
    # up to 1/16 px; the rest of the error is noise and a small pixel locking.
    plain, corrected = [], []
    for shift in np.arange(20, 21, 1 / 8):
        left, right = speckled_pair(shift)
        error = match(left, right, MatchingSettings(num_disparities=64, block_size=15)) - shift
        inner = error[20:-20, 100:-20]
        assert np.isfinite(inner).mean() > 0.95
        assert (np.abs(inner[np.isfinite(inner)]) > 1).mean() < 0.01
        plain.append(np.nanmean(np.where(np.abs(inner) < 1, inner, np.nan)))
        unbiased = MatchingSettings(num_disparities=64, block_size=15, bias_correction=True)
        again = (match(left, right, unbiased) - shift)[20:-20, 100:-20]
        corrected.append(np.nanmean(np.where(np.abs(inner) < 1, again, np.nan)))
    assert np.mean(plain) == pytest.approx(0.030, abs=0.008)
    assert np.mean(corrected) == pytest.approx(0.0, abs=0.008)


def test_convention_disparity_is_positive_for_a_right_image_moved_left():
    left, right = speckled_pair(25.0)
    settings = MatchingSettings(num_disparities=64, block_size=15)
    assert np.nanmedian(match(left, right, settings)) == pytest.approx(25, abs=0.1)
    swapped = match(right, left, settings)
    assert np.isfinite(swapped).mean() < 0.1


def test_left_band_is_empty():
    left, right = speckled_pair(20.0)
    disparity = match(left, right, MatchingSettings(num_disparities=64, block_size=15))
    assert np.isnan(disparity[:, : 64 + 15 // 2 - 1]).all()
    assert np.isfinite(disparity[100]).any()


def test_disparity_is_a_multiple_of_a_sixteenth():
    left, right = speckled_pair(20.3)
    disparity = match(left, right, MatchingSettings(num_disparities=64, block_size=15))
    steps = disparity[np.isfinite(disparity)] * 16
    np.testing.assert_array_equal(steps, np.round(steps))


@pytest.mark.parametrize(
    "region",
    [Region(300, 90, 60, 50), Region(0, 0, 30, 20), Region(380, 150, 40, 50), Region(200, 0, 9, 9)],
)
def test_region_matching_equals_full_frame_matching_bit_for_bit(region):
    left, right = speckled_pair(20.3, noise=6.0)
    rig = StereoRig(width=420, height=200, focal=500.0)
    settings = MatchingSettings(num_disparities=64, block_size=15)
    whole = match(left, right, settings)[region.slices]
    canvas = matching_canvas(region, rig, settings)
    part = match(left[canvas.slices], right[canvas.slices], settings)
    y, x = region.y - canvas.y, region.x - canvas.x
    np.testing.assert_array_equal(part[y : y + region.height, x : x + region.width], whole)


@pytest.mark.parametrize("kwargs", [{"num_disparities": 50}, {"block_size": 8}, {"block_size": 3}])
def test_matching_settings_are_checked(kwargs):
    with pytest.raises(InputError, match="matching"):
        MatchingSettings(**kwargs)


def test_too_small_an_image_is_refused():
    with pytest.raises(InputError, match="too small"):
        match(np.zeros((50, 50), np.uint8), np.zeros((50, 50), np.uint8), MatchingSettings())


def test_statistics_measure_what_they_say():
    rig = StereoRig()
    rng = np.random.default_rng(0)
    depth = np.full((120, 120), np.nan)
    depth[30:90, 30:90] = 3.0
    disparity = np.full((120, 120), np.nan)
    disparity[30:90, 30:90] = 50.0 + 0.1 + 0.2 * rng.standard_normal((60, 60))
    disparity[30:36, 30:90] = np.nan  # a tenth of the object is not matched
    disparity[36:42, 30:60] += 20.0  # a twentieth of it is grossly wrong
    disparity[20:30, 30:90] = 50.0  # one of four sides of the ring is fattened
    found = view_statistics(disparity, depth, rig)
    assert found.object_pixels == 3600
    assert found.valid_fraction == pytest.approx(0.9)
    assert found.gross_share == pytest.approx(180 / 3240)
    assert found.disparity_bias == pytest.approx(0.1, abs=0.03)
    assert found.disparity_sigma == pytest.approx(0.2, rel=0.15)
    assert found.ring_fraction == pytest.approx(0.22, abs=0.03)


@pytest.mark.parametrize("shape", [(5, 5), (0, 0)])
def test_statistics_of_nothing_are_none(shape):
    empty = np.full(shape, np.nan)
    found = view_statistics(empty, empty, StereoRig())
    assert found.object_pixels == 0
    assert found.valid_fraction is None
    assert found.disparity_sigma is None
    assert found.ring_fraction is None
