"""No noise of the renderer passes for noise of the sensor: more rays change no statistic."""

import pytest
import trimesh

from qs3.sensor.light.materials import MATERIALS
from qs3.sensor.light.mitsuba import MitsubaRenderer, best_variant
from qs3.sensor.rig import StereoRig
from qs3.sensor.scan import scan
from qs3.sensor.stage.randomise import COMMON_MATERIALS

# Half a D435's pixels each way.
SMALL = StereoRig(width=424, height=240, focal=215.0, baseline=0.05, projector_offset=0.58)
BLOCK = trimesh.creation.box((0.8, 0.5, 0.7))


def errors(material, renderer, sensor="d435", rig=SMALL, seed=3, scene="room", size=0.8):
    options = {"scene": scene, "views": 1, "num_points": 64, "elevation": (30.0, 40.0)}
    options |= {"object_size": size}
    [view] = scan(
        BLOCK, sensor=sensor, rig=rig, material=material, renderer=renderer, seed=seed, **options
    ).views
    return view.disparity_sigma, view.valid_fraction


def assert_as_with_many(material, times=64, **where):
    """Of the fastest variant and of the one that every machine has."""
    few = [MitsubaRenderer(variant) for variant in {best_variant(), "scalar_rgb"}]
    # Of a cell's rays a metal has 16 times as many already.
    more = max(1, round(16 * MATERIALS[material].coat))
    many = MitsubaRenderer(best_variant(), times * few[0].rays, cache_rays=times * 32 // more)
    expected = errors(material, many, **where)
    for renderer in few:
        assert errors(material, renderer, **where) == pytest.approx(expected, rel=0.1)


needs_speed = pytest.mark.skipif(
    best_variant() == "scalar_rgb", reason="no fast variant, many rays take minutes"
)


@needs_speed
@pytest.mark.parametrize("material", ["glossy-plastic"])
def test_more_rays_change_no_noise_of_a_small_thing(material):
    assert_as_with_many(material, 16, scene="floor", size=0.3)


@needs_speed
@pytest.mark.slow
@pytest.mark.parametrize("material", COMMON_MATERIALS)
def test_sixty_four_times_as_many_rays_change_noise_and_valid_pixels_by_a_tenth_at_most(material):
    assert_as_with_many(material)
