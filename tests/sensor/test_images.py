import numpy as np
import pytest

from qs3.sensor.rig import StereoRig
from qs3.sensor.statistics import view_statistics


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
