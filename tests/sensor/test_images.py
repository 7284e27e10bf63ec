import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from qs3.errors import InputError
from qs3.sensor.exposure import ExposureSettings, expose
from qs3.sensor.rig import StereoRig
from qs3.sensor.speckle import PatternSettings, pattern_image, speckle_pattern
from qs3.sensor.statistics import view_statistics


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
