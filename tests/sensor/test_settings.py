"""Settings of a scan: presets, changes of the sensor, records."""

import collections
import dataclasses
from typing import Literal

import numpy as np
import pytest
import trimesh
from scipy import stats

from qs3.errors import InputError
from qs3.sensor.checks import check_choices
from qs3.sensor.materials import get_material
from qs3.sensor.presets import SENSORS
from qs3.sensor.render.cycles import CyclesRenderer
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.rig import StereoRig
from qs3.sensor.scan import scan
from qs3.sensor.scene import SceneSettings
from qs3.sensor.settings import PRESETS, CameraSettings, ScanSettings
from qs3.sensor.speckle import PatternSettings
from qs3.sensor.staging import choose


def test_a_preset_is_a_whole_column_and_what_is_given_beside_it_wins():
    released = ScanSettings(preset="released")
    column = {name: released.chosen(name) for name in PRESETS["released"]}
    assert column == PRESETS["released"]
    assert released.make_sensor().depth.principal_point == "released"
    assert released.as_dict()["view_layout"] == "jitter"
    beside = ScanSettings(preset="released", view_layout="orbit", principal_point="true")
    assert beside.chosen("view_layout") == "orbit"
    assert beside.make_sensor() == SENSORS["paper"]
    assert ScanSettings(preset="paper").as_dict()["box_crop"] is False


def test_changes_go_where_they_belong_in_the_sensor():
    changes = {"image_noise": 2.0, "matching": "opencv-bm", "object_size": 0.5, "material": "dark"}
    sensor, base = ScanSettings(sensor="d435", **changes).make_sensor(), SENSORS["d435"]
    assert sensor.exposure == dataclasses.replace(base.exposure, noise=2.0)
    assert sensor.matching == dataclasses.replace(base.matching, method="opencv-bm")
    assert (sensor.object_size, sensor.material) == (0.5, get_material("dark"))


def test_a_scene_by_name_takes_surfaces_by_name():
    settings = ScanSettings(scene="room", floor_material="dark")
    assert settings.make_scene() == SceneSettings("room", floor=get_material("dark"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_points": 0}, "num_points 0"),
        ({"samples": 0}, "samples 0"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_settings_are_checked(changes, message):
    with pytest.raises(InputError, match=message):
        ScanSettings(**changes)


@dataclasses.dataclass(frozen=True)
class Choice:
    word: Literal["a", "b"] | None = None


def test_a_choice_may_be_left_open_but_not_be_another_word():
    check_choices(Choice(), "room")
    check_choices(Choice("b"), "room")
    with pytest.raises(InputError, match="no word 'c'; choose one of a, b"):
        check_choices(Choice("c"), "room")  # pyright: ignore[reportArgumentType]


def test_a_renderer_refuses_what_is_anothers():
    with pytest.raises(InputError, match="variant: scalar_rgb is Mitsuba's"):
        CameraSettings(renderer="cycles", variant="scalar_rgb").make_renderer()
    with pytest.raises(InputError, match="view_transform: Filmic needs"):
        CameraSettings(view_transform="Filmic").make_renderer()


def test_a_keyword_that_is_no_setting_is_refused():
    with pytest.raises(TypeError, match="viwes"):
        scan(trimesh.creation.box(), viwes=3)


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (ScanSettings, {"num_points": 10**7}, "num_points 10000000 must be .* at most 1000000"),
        (ScanSettings, {"num_points": 1e12}, "num_points 1000000000000.0 must be a whole number"),
        (ScanSettings, {"num_points": "x"}, "num_points 'x' must be a whole number"),
        (ScanSettings, {"num_points": True}, "num_points True must be a whole number"),
        (ScanSettings, {"views": 257}, "views 257"),
        (ScanSettings, {"samples": 10**9}, "samples 1000000000 must be .* at most 65536"),
        (StereoRig, {"width": 100_000}, "a film of 100000 × 1080 pixels"),
        (PatternSettings, {"columns": 3 * 10**6}, "columns 3000000"),
        (PatternSettings, {"tan_half_height": 1e6}, "tan_half_width"),
        (CyclesRenderer, {"samples": 10**9}, "samples"),
        (MitsubaRenderer, {"cache_rays": 10**9}, "cache_rays"),
        (MitsubaRenderer, {"max_depth": 10**9}, "max_depth"),
    ],
)
def test_absurd_sizes_are_refused_before_anything_is_allocated(kind, changes, message):
    settings = kind()
    for name, value in changes.items():
        object.__setattr__(settings, name, value)  # past the tests' own check of types
    with pytest.raises(InputError, match=message):
        settings.__post_init__()


def test_each_scan_draws_one_of_several_sensors_and_a_number_of_views_evenly():
    names = ("d415", "d435", "d455", "kinect-v1")
    settings = ScanSettings(sensor=names, views=5, least_views=1)
    several = [choose(settings, np.random.default_rng(seed)) for seed in range(600)]
    for name, values in {"sensor": names, "views": (1, 2, 3, 4, 5)}.items():
        counts = collections.Counter(drawn[name] for _, drawn in several)
        assert set(counts) == set(values)
        assert stats.chisquare(list(counts.values())).pvalue > 0.01
    for how, drawn in several[:50]:
        assert how.make_sensor() == SENSORS[drawn["sensor"]]
        assert (how.views, how.least_views) == (drawn["views"], None)
    one = dataclasses.replace(settings, sensor="d435")  # neither depends on the other
    same = [choose(one, np.random.default_rng(seed))[1] for seed in range(50)]
    assert same == [{"views": drawn["views"]} for _, drawn in several[:50]]
    assert choose(ScanSettings(), np.random.default_rng(0)) == (ScanSettings(), {})


def test_several_sensors_are_recorded_and_refused_where_one_is_needed():
    settings = ScanSettings(sensor=("d435", SENSORS["kinect-v1"]), randomise="rooms")
    alone = [dataclasses.replace(settings, sensor=name) for name in ("d435", "kinect-v1")]
    assert settings.as_dict()["randomise"] == [one.as_dict()["randomise"] for one in alone]
    assert (settings.real_size, settings.needs_neighbour) == ("class", True)
    with pytest.raises(InputError, match=r"one is needed here, not several \(d435, kinect-v1\)"):
        settings.make_sensor()
    for views, least in ((2, 3), (2, 0)):
        with pytest.raises(InputError, match="least_views"):
            ScanSettings(views=views, least_views=least)
