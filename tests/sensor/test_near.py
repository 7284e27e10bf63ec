"""Cameras near the object: places of one's own, and a search that reaches as near."""

import dataclasses
import re

import numpy as np
import pytest
import trimesh

from qs3 import load_sensor, shapes
from qs3.errors import TOLD, InputError
from qs3.sensor.presets import SENSORS, changed
from qs3.sensor.scan import scan
from qs3.sensor.stage.settings import ScanSettings
from qs3.sensor.stage.stage import Streams, resized, stages

from ..sensors import METRIC

PART = trimesh.creation.box((0.08, 0.05, 0.03))
D415 = load_sensor("d415")


@pytest.mark.parametrize("name", SENSORS)
def test_presets_search_at_their_own_distances_as_far_as_ever(name):
    sensor = SENSORS[name]
    for share in (0.1, 1.0, 3.0):
        placed = resized(sensor, share * sensor.object_size, ScanSettings(sensor=sensor))
        assert placed.matching == sensor.matching


def test_the_search_reaches_the_nearest_point_and_says_so_once(caplog):
    TOLD.clear()
    for near, wanted in ((0.3, 176), (0.2, 208)):  # the gate; the part, at 0.26 m
        sensor = changed(D415, "depth.near", near)
        settings = ScanSettings(sensor=sensor, distance=(0.3, 0.5))
        placed = resized(settings.make_sensor(), 0.08, settings)
        nearest = max(near, placed.placement.radius[0] - 0.04)
        assert placed.rig.disparity(nearest) < placed.matching.num_disparities == wanted
    assert "176 disparities, not 128" in caplog.text
    assert len(caplog.messages) == 1


@pytest.mark.parametrize("seed", range(5))
def test_views_stand_at_the_distance_and_elevation_asked_for(seed, renderer):
    settings = ScanSettings(sensor="d435", distance=(0.35, 0.8), elevation=(35.0, 80.0), views=4)
    settings = dataclasses.replace(settings, object_size=0.08, renderer=renderer)
    stands = list(stages(PART, settings, Streams.of(seed)))
    assert [stand.drawn.get("redraws") for stand in stands] == [None, *range(1, 10)]
    for stand in stands:
        places = np.array([pose.position for pose in stand.poses])
        radii = np.linalg.norm(places, axis=1)
        height = np.degrees(np.arcsin(places[:, 2] / radii))
        assert ((radii >= 0.35) & (radii <= 0.8)).all()
        assert ((height >= 35) & (height <= 80)).all()


def test_the_gate_holds_half_the_object():
    settings = ScanSettings(sensor="d415", distance=(0.3, 0.8))
    assert resized(settings.make_sensor(), 0.1, settings).placement.radius == pytest.approx(
        (0.5, 0.8)
    )
    assert resized(settings.make_sensor(), 1.0, settings).placement.radius == pytest.approx(
        (0.95, 0.95)
    )
    with pytest.raises(InputError, match=r"d415 measures from 0\.45"):
        ScanSettings(sensor="d415", distance=(0.3, 0.4)).make_sensor()
    with pytest.raises(InputError, match=r"use room\.distance"):
        ScanSettings(sensor="d435", distance=(1.0, 2.0), randomise=["rooms"])


def test_all_of_a_ball_lies_behind_the_gate_and_within_the_search():
    """Its size is its radius, not its longest side."""
    settings = ScanSettings(size="ball", distance=(1.2, 1.3))
    placed = resized(settings.make_sensor(), 1.0, settings)
    assert placed.placement.radius == (2.0, 2.0)
    narrow = changed(settings.make_sensor(), "matching.num_disparities", 64)
    settings = ScanSettings(sensor=narrow, size="ball", distance=(2.5, 3.0))
    placed = resized(settings.make_sensor(), 1.0, settings)
    assert placed.rig.disparity(1.5) < placed.matching.num_disparities


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_within_a_large_neighbour_is_placed_again(seed, renderer):
    settings = ScanSettings(sensor="d435", distance=(0.35, 0.8), elevation=(35.0, 80.0), views=1)
    settings = dataclasses.replace(settings, object_size="file", scene="beside", renderer=renderer)
    large = trimesh.creation.box((0.9, 0.7, 0.6))
    assert next(stages(PART, settings, Streams.of(seed), neighbour=large)).poses
    settings = dataclasses.replace(settings, scene="behind")
    with pytest.raises(InputError, match="no room for a neighbour"):
        next(stages(PART, settings, Streams.of(seed), neighbour=large))


def test_a_drawn_scene_has_a_neighbour_only_where_it_needs_one(renderer):
    """And without one the cloud is that of the scene alone."""
    options = {
        "sensor": "d435",
        "object_size": "file",
        "distance": (0.3, 0.4),
        "views": 1,
        "num_points": 64,
        "crop": "mask",
        "renderer": renderer,
        "rig": dataclasses.replace(SENSORS["d435"].rig, width=212, height=120, focal=107.5),
    }
    drawn = {}
    for seed in range(6):
        result = scan(PART, scene=("table", "table+beside"), neighbour=PART, seed=seed, **options)
        drawn.setdefault(result.drawn["scene"], (seed, result))
        assert ("neighbour_object_size" in result.drawn) == (result.drawn["scene"] != "table")
        if len(drawn) == 2:
            break
    seed, result = drawn["table"]
    alone = scan(PART, scene="table", seed=seed, **options)
    np.testing.assert_array_equal(alone.points, result.points)
    assert "table+beside" in drawn


def test_a_neighbour_and_a_class_may_be_given_by_name(renderer):
    """A chair beside a chair is another one."""
    rig = dataclasses.replace(SENSORS["d435"].rig, width=212, height=120, focal=107.5)
    options = {"sensor": "d435", "scene": "beside", "views": 1, "num_points": 64, "rig": rig,
           "object_size": "class", "renderer": renderer}  # fmt: skip
    named = scan("chair", neighbour="chair", class_names="chair", **options)
    chairs = [shapes.make("chair", seed=seed) for seed in (0, 1)]
    result = scan(chairs[0], neighbour=chairs[1], class_names=["chair"], **options)
    np.testing.assert_array_equal(named.points, result.points)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_scan_of_few_pixels_is_none_whatever_the_grid(stride, renderer):
    """About 95 pixels are too few, though every one of them is a point; 350 are enough."""
    settings = ScanSettings(sensor=METRIC, distance=(1.0, 1.0), elevation=(80.0, 80.0), views=1)
    settings = dataclasses.replace(
        settings, stride=stride, crop="mask", scene="floor", renderer=renderer
    )
    slab = trimesh.creation.box((1, 1, 0.2))
    with pytest.raises(InputError, match=r"saw \d+ points of the object") as caught:
        scan(slab, settings, object_size=0.023, seed=1)
    seen = int(re.findall(r"saw (\d+)", str(caught.value))[0])
    assert 60 <= stride**2 * seen < 128
    assert scan(slab, settings, object_size=0.046, seed=1).fused_points * stride**2 > 200
