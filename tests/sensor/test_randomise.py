"""Settings drawn for each object: within their ranges, from its own seed, recorded."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy import stats

from qs3.sensor.light.materials import MATERIALS
from qs3.sensor.matching.settings import unread
from qs3.sensor.presets import SENSORS, Sensor, changed
from qs3.sensor.scan import scan
from qs3.sensor.stage import randomise
from qs3.sensor.stage.randomise import numbers_of, resolve_ranges

from ..clouds.hostile import refused


def draw(sensor, ranges, rng):
    return randomise.draw(sensor, resolve_ranges(sensor, ranges), rng)


def many(ranges, count=200, sensor=None):
    sensor = sensor or Sensor()
    resolved = resolve_ranges(sensor, ranges)
    return [randomise.draw(sensor, resolved, np.random.default_rng(i)) for i in range(count)]


def test_a_uniform_range_is_drawn_uniformly():
    values = [drawn["light.ambient"] for _, drawn in many({"light.ambient": (0.1, 0.3)})]
    assert stats.kstest(values, stats.uniform(0.1, 0.2).cdf).pvalue > 0.01


def test_a_log_range_is_drawn_uniformly_in_the_logarithm():
    ranges = {"exposure.gain": (0.25, 4.0, "log")}
    values = np.log([drawn["exposure.gain"] for _, drawn in many(ranges)])
    assert stats.kstest(values, stats.uniform(np.log(0.25), np.log(16)).cdf).pvalue > 0.01


def test_the_usual_ranges_lie_about_the_sensors_own_light_and_gain():
    preset = SENSORS["d435"]
    ranges, gain, light = resolve_ranges(preset, "default"), preset.exposure.gain, preset.light
    assert ranges["exposure.gain"] == (pytest.approx(0.7 * gain), pytest.approx(1.4 * gain), "log")
    assert ranges["light.ambient"] == pytest.approx((0, 2 * light.ambient))
    assert ranges["light.projector"] == (light.projector / 2, 2 * light.projector, "log")


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


def test_a_setting_of_a_material_is_drawn_for_those_that_read_it():
    ranges = {"material": ("diffuse", "metal"), "material.roughness": (0.1, 0.2)}
    kinds = set()
    for sensor, drawn in many(ranges, 20):
        kinds.add(drawn["material"])
        assert ("material.roughness" in drawn) == (drawn["material"] == "metal")
        assert sensor.material.reads("roughness") == ("material.roughness" in drawn)
    assert kinds == {"diffuse", "metal"}


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


@pytest.mark.parametrize("name", ["paper", "d435", "kinect-v1"])
def test_every_number_that_the_sensor_reads_can_be_held_at_its_value(name):
    preset, held = SENSORS[name], 0
    for name in numbers_of(preset):
        if name.startswith("matching.") and name.split(".")[1] in unread(preset.matching.method):
            continue
        value = preset
        for part in name.split("."):
            value = getattr(value, part)
        sensor, drawn = draw(preset, {name: (value, value)}, np.random.default_rng(0))
        assert sensor == preset
        assert drawn == {name: value}
        held += 1
    assert held > 30


@pytest.mark.parametrize(
    ("sensor", "ranges", "wanted"),
    [
        ("d435", "matching.block_size=9:21", range(9, 22, 2)),
        ("paper", "matching.num_disparities=128:192", range(128, 193, 16)),
        ("d435", "matching.num_disparities=126:130", range(126, 131)),
        ("d435", "matching.ad_census.census_width=3:9", range(3, 10, 2)),
        ("paper", "pattern.columns=597:609", range(597, 610, 3)),
        ("d415", "pattern.rows=180:210", range(180, 211, 15)),
    ],
)
def test_only_whole_numbers_that_the_sensor_takes_are_drawn_and_each_as_often(
    sensor, ranges, wanted
):
    name = ranges.partition("=")[0]
    drawn = [d[name] for _, d in many([ranges], 400, SENSORS[sensor])]
    counts = [drawn.count(value) for value in wanted]
    assert sum(counts) == len(drawn)
    assert stats.chisquare(counts).pvalue > 0.01


def test_ranges_that_fit_together_are_drawn_whichever_comes_first():
    census = "matching.ad_census."
    together = {f"{census}penalty_small": (0.1, 0.3), f"{census}penalty_large": (0.4, 0.8)}
    together |= {f"{census}census_height": (9, 9), f"{census}census_width": (3, 7)}
    for sensor, drawn in many(together, 50, SENSORS["d435"]):
        costs = sensor.matching.ad_census
        assert costs.penalty_small == drawn[f"{census}penalty_small"] <= 0.3
        assert costs.penalty_large == drawn[f"{census}penalty_large"] <= 0.8
        assert costs.census_width in (3, 5, 7)
        assert costs.census_height == 9


@pytest.mark.parametrize(
    ("sensor", "ranges", "message"),
    [
        ("d435", ["matching.quantum=0:0.5"], "quantum has gaps.*give one value"),
        ("d435", ["matching.block_size=8:21"], "block_size=8 may be drawn.*not odd"),
        ("d435", ["depth.near=0.1:3", "depth.far=2:6"], "far=2, depth.near=3 may be drawn.*order"),
        (
            "d435",
            ["matching.ad_census.penalty_small=0.1:0.5", "matching.ad_census.penalty_large=0.4:1"],
            "penalty_large=0.4, .*penalty_small=0.5 may be drawn",
        ),
        (
            "d435",
            ["matching.ad_census.census_width=5:9", "matching.ad_census.census_height=5:9"],
            "leave 2 to 64 pixels",
        ),
        ("d435", ["matching.texture=1:2"], "^randomise: matching: ad-census never reads texture"),
        ("paper", ["matching.ad_census.arm=3:9"], "opencv-bm never reads ad_census"),
        ("kinect-v1", ["matching.ad_census.arm=3:9"], "zncc never reads ad_census"),
        ("d435", ["material.metallic=0:1"], "diffuse never reads metallic"),
        ("d435", ["material=diffuse,dark", "material.roughness=0.1:1"], "diffuse, dark reads it"),
        ("d435", ["light.sky_elevation=0:91"], "sky_elevation 91"),
        ("d435", [f"pattern.{n}=1:2" for n in "abc"], "no number 'pattern.a'"),
    ],
)
def test_ranges_that_hold_what_the_sensor_refuses_are_refused(sensor, ranges, message):
    with refused(message):
        resolve_ranges(SENSORS[sensor], ranges)


@pytest.mark.parametrize("name", SENSORS)
def test_values_set_together_make_the_sensor_that_they_make_one_by_one(name):
    ranges = {"material.albedo": (0.3, 0.6), **resolve_ranges(SENSORS[name], "default")}
    for sensor, drawn in many(ranges, 20, SENSORS[name]):
        apart = SENSORS[name]
        assert set(drawn) == set(ranges)
        for key in sorted(drawn):
            apart = changed(apart, key, drawn[key])
            assert key == "material" or ranges[key][0] <= drawn[key] <= ranges[key][1]
        assert apart == sensor


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
    with refused(message):
        resolve_ranges(Sensor(), ranges)


def test_a_scan_records_its_draws_and_keeps_its_poses(renderer, small_rig):
    box = trimesh.creation.box(extents=[1.0, 0.9, 0.8])
    ranges = {"exposure.gain": (1.5, 2.0), "light.ambient": (0.1, 0.2)}
    options = {"views": 1, "seed": 6, "num_points": 64, "keep_images": True}
    options |= {"renderer": renderer, "rig": small_rig}
    plain = scan(box, **options)
    drawn = [scan(box, randomise=ranges, **options) for _ in range(2)]
    assert plain.drawn == {}
    assert plain.sensor == dataclasses.replace(Sensor(), rig=small_rig)
    assert drawn[0].drawn == drawn[1].drawn
    assert set(drawn[0].drawn) == set(ranges)
    assert drawn[0].sensor.exposure.gain == drawn[0].drawn["exposure.gain"]
    np.testing.assert_array_equal(drawn[0].points, drawn[1].points)
    np.testing.assert_array_equal(plain.poses[0].camera_to_world, drawn[0].poses[0].camera_to_world)
    np.testing.assert_array_equal(plain.images[0].true_depth, drawn[0].images[0].true_depth)
    assert drawn[0].images[0].left.mean() > plain.images[0].left.mean() + 20
