from types import SimpleNamespace

import pytest

from qs3.sensor.light.mitsuba import MitsubaRenderer
from qs3.sensor.rig import StereoRig

from ..stores import once


@pytest.fixture(scope="session")
def fresh_renderer() -> MitsubaRenderer:
    return MitsubaRenderer(variant="scalar_rgb", samples=4)


@pytest.fixture(scope="module")
def renderer(fresh_renderer) -> SimpleNamespace:
    """Renders as ``fresh_renderer``, and what is the same only once in a module."""
    render = once(fresh_renderer.render, kept={})
    return SimpleNamespace(description=fresh_renderer.description, render=render)


@pytest.fixture(scope="session")
def small_rig() -> StereoRig:
    """A rig of a quarter of the pixels, with f·b = 75 and disparities from 15 to 60."""
    return StereoRig(width=540, height=540, focal=750.0, baseline=0.1)
