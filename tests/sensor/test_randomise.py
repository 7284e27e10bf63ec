"""Settings drawn for each object: within their ranges, from its own seed, recorded."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy import stats

from qs3.errors import InputError
from qs3.sensor import randomise
from qs3.sensor.materials import MATERIALS
from qs3.sensor.presets import SENSORS, Sensor
from qs3.sensor.randomise import numbers_of, resolve_ranges
from qs3.sensor.scan import scan


def draw(sensor, ranges, rng):
    return randomise.draw(sensor, resolve_ranges(sensor, ranges), rng)


def many(ranges, count=200, sensor=None):
    return [draw(sensor or Sensor(), ranges, np.random.default_rng(i)) for i in range(count)]


def test_a_uniform_range_is_drawn_uniformly():
    values = [drawn["light.ambient"] for _, drawn in many({"light.ambient": (0.1, 0.3)})]
    assert stats.kstest(values, stats.uniform(0.1, 0.2).cdf).pvalue > 0.01


def test_a_log_range_is_drawn_uniformly_in_the_logarithm():
    ranges = {"exposure.gain": (0.25, 4.0, "log")}
    values = np.log([drawn["exposure.gain"] for _, drawn in many(ranges)])
    assert stats.kstest(values, stats.uniform(np.log(0.25), np.log(16)).cdf).pvalue > 0.01


def test_every_material_and_every_whole_number_has_its_turn():
    ranges = {"material": ("dark", "metal", "glass"), "pattern.seed": (0, 3)}
    drawn = [d for _, d in many(ranges)]
    for name, values in {"material": ranges["material"], "pattern.seed": (0, 1, 2, 3)}.items():
        counts = [sum(d[name] == value for d in drawn) for value in values]
        assert sum(counts) == len(drawn)
        assert stats.chisquare(counts).pvalue > 0.01


def test_the_sensor_has_what_was_drawn_and_nothing_else_changed():
    ranges = {"material": ["metal"], "material.roughness": (0.1, 0.2), "light.projector": (5, 9)}
    sensor, drawn = draw(Sensor(), ranges, np.random.default_rng(1))
    metal = dataclasses.replace(MATERIALS["metal"], roughness=drawn["material.roughness"])
    assert sensor.material == metal
    assert sensor.light.projector == drawn["light.projector"]
    light = dataclasses.replace(sensor.light, projector=Sensor().light.projector)
    assert dataclasses.replace(sensor, material=Sensor().material, light=light) == Sensor()
    assert 0.1 <= drawn["material.roughness"] <= 0.2


def test_equal_seeds_draw_equally_in_any_order_of_names():
    ranges = {
        "light.ambient": (0.0, 1.0),
        "exposure.gain": (0.5, 2.0),
        "material": ("dark", "metal"),
    }
    turned = dict(reversed(ranges.items()))
    a, b = (draw(Sensor(), r, np.random.default_rng(9)) for r in (ranges, turned))
    assert a == b
    assert a != draw(Sensor(), ranges, np.random.default_rng(10))


@pytest.mark.parametrize("name", SENSORS)
def test_the_default_ranges_suit_every_sensor(name):
    sensor = SENSORS[name]
    ranges = resolve_ranges(sensor, "default")
    for _, drawn in many("default", 20, sensor):
        assert set(drawn) == set(ranges)
        for key, value in drawn.items():
            if key != "material":
                assert ranges[key][0] <= value <= ranges[key][1]


def test_every_number_of_the_sensor_can_be_held_at_its_value():
    for name in numbers_of(Sensor()):
        value = Sensor()
        for part in name.split("."):
            value = getattr(value, part)
        sensor, drawn = draw(Sensor(), {name: (value, value)}, np.random.default_rng(0))
        assert sensor == Sensor()
        assert drawn == {name: value}


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"light.ambiant": (0, 1)}, "light.ambiant.*light.ambient"),
        ({"light": (0, 1)}, "no number 'light'"),
        ({"light.ambient": (0.2, 0.1)}, "light.ambient"),
        ({"light.ambient": (0.0, 0.1, "log")}, "log"),
        ({"light.ambient": "0:1"}, "light.ambient"),
        ({"light.ambient": (-1, 1)}, "ambient"),
        ({"material": ("velvet",)}, "velvet"),
        ({"pattern.seed": (0.5, 2.0)}, "whole"),
        ("wild", "'wild' is not understood"),
        (["default", "x=0:1"], "'default' is not understood"),
        (["x=0:1", "x=0:2"], "named twice"),
    ],
)
def test_bad_ranges_are_refused_in_one_line(ranges, message):
    with pytest.raises(InputError, match=message) as caught:
        resolve_ranges(Sensor(), ranges)
    assert "\n" not in str(caught.value)


def test_a_scan_records_its_draws_and_keeps_its_poses(renderer, small_rig):
    box = trimesh.creation.box(extents=[1.0, 0.9, 0.8])
    ranges = {"exposure.gain": (1.5, 2.0), "light.ambient": (0.1, 0.2)}
    how = {"views": 1, "seed": 6, "num_points": 64, "keep_images": True}
    how |= {"renderer": renderer, "rig": small_rig}
    plain = scan(box, **how)
    drawn = [scan(box, randomise=ranges, **how) for _ in range(2)]
    assert plain.drawn == {}
    assert plain.sensor == dataclasses.replace(Sensor(), rig=small_rig)
    assert drawn[0].drawn == drawn[1].drawn
    assert set(drawn[0].drawn) == set(ranges)
    assert drawn[0].sensor.exposure.gain == drawn[0].drawn["exposure.gain"]
    np.testing.assert_array_equal(drawn[0].points, drawn[1].points)
    np.testing.assert_array_equal(plain.poses[0].camera_to_world, drawn[0].poses[0].camera_to_world)
    np.testing.assert_array_equal(plain.images[0].true_depth, drawn[0].images[0].true_depth)
    assert drawn[0].images[0].left.mean() > plain.images[0].left.mean() + 20
