import pytest

from qs3.sensor.light.mitsuba import MitsubaRenderer
from qs3.sensor.rig import StereoRig


@pytest.fixture(scope="session")
def renderer() -> MitsubaRenderer:
    return MitsubaRenderer(variant="scalar_rgb", samples=4)


@pytest.fixture(scope="session")
def small_rig() -> StereoRig:
    """A rig of a quarter of the pixels, with f·b = 75 and disparities from 15 to 60."""
    return StereoRig(width=540, height=540, focal=750.0, baseline=0.1)
