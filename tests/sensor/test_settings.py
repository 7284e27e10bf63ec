"""Settings of a scan: presets, changes of the sensor, records."""

import collections
import contextlib
import dataclasses
import re
import tomllib
from typing import get_args

import numpy as np
import pytest
from scipy import stats

from qs3.errors import InputError
from qs3.sensor.depth import DepthSettings
from qs3.sensor.exposure import ExposureSettings
from qs3.sensor.light import LightSettings
from qs3.sensor.light.cycles import CyclesRenderer
from qs3.sensor.light.materials import Material, get_material
from qs3.sensor.light.mitsuba import MitsubaRenderer
from qs3.sensor.light.pattern import PatternSettings
from qs3.sensor.matching.settings import AdCensusSettings, MatchingSettings, Method
from qs3.sensor.placement import Placement
from qs3.sensor.presets import SENSORS
from qs3.sensor.rig import StereoRig
from qs3.sensor.stage.scene import SceneSettings
from qs3.sensor.stage.settings import PRESETS, ScanSettings
from qs3.sensor.stage.stage import choose


def test_a_preset_is_a_whole_column_and_what_is_given_beside_it_wins():
    released = ScanSettings(preset="released")
    column = {name: released.chosen(name) for name in PRESETS["released"]}
    assert column == PRESETS["released"]
    assert released.make_sensor().depth.principal_point == "released"
    assert released.as_dict()["view_layout"] == "jitter"
    beside = ScanSettings(preset="released", view_layout="orbit", principal_point="true")
    assert beside.chosen("view_layout") == "orbit"
    blender = dataclasses.replace(SENSORS["paper"], material=get_material("principled"))
    assert beside.make_sensor() == blender == ScanSettings(preset="paper").make_sensor()
    assert ScanSettings(preset="paper").as_dict()["box_crop"] is False


@pytest.mark.parametrize(
    ("settings", "crop"),
    [
        ({}, "box"),
        ({"matching": "ad-census"}, "box"),
        ({"sensor": "kinect-v1"}, "both"),
        ({"sensor": "d435", "matching": "zncc"}, "both"),
        ({"sensor": ("paper", "d415")}, "both"),
        ({"sensor": "d435", "crop": "box"}, "box"),
        ({"sensor": "d435", "preset": "paper"}, "none"),
        ({"sensor": "d435", "preset": "released"}, "box"),
    ],
)
def test_scans_by_cameras_in_metres_are_cropped_by_the_mask_too(settings, crop):
    assert ScanSettings(**settings).chosen("crop") == crop


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("views", None),
        ("seed", None),
        ("remove_outliers", "no"),
        ("bias_correction", None),
        ("distance", 0.5),
        ("distance", (1.0,)),
        ("distance", "0.4:0.5"),
        ("distance", (2.0, 1.0)),
        ("elevation", (None, 30.0)),
        ("elevation", (0.0, float("nan"))),
        ("table_cut", 0.01),
        ("table_cut", (0.2, 0.1)),
        ("scene", 5),
        ("scene", ()),
        ("scene", ["table", "floor"]),
        ("sensor", ()),
        ("sensor", None),
        ("renderer", None),
        ("randomise", 5),
        ("randomise", [None]),
        ("randomise", {"light.ambient": 0.1}),
        ("randomise", {5: (0, 1)}),
    ],
)
def test_values_of_another_kind_are_refused_by_name(name, value):
    settings = ScanSettings(sensor="d435")
    object.__setattr__(settings, name, value)  # past the tests' own check of types
    with pytest.raises(InputError, match=name):
        settings.__post_init__()


def test_a_sensor_may_be_named_by_a_path(tmp_path):
    (tmp_path / "mine.toml").write_text('base = "d435"')
    settings = ScanSettings(sensor="d435")
    object.__setattr__(settings, "sensor", tmp_path / "mine.toml")  # past the tests' check of types
    settings.__post_init__()
    assert settings.make_sensor().name == "mine"


def test_changes_go_where_they_belong_in_the_sensor():
    changes = {"image_noise": 2.0, "matching": "opencv-bm", "object_size": 0.5, "material": "dark"}
    sensor, base = ScanSettings(sensor="d435", **changes).make_sensor(), SENSORS["d435"]
    assert sensor.exposure == dataclasses.replace(base.exposure, noise=2.0)
    matching = base.matching
    kept = {
        name: getattr(matching, name) for name in ("num_disparities", "block_size", "left_band")
    }
    assert sensor.matching == MatchingSettings("opencv-bm", quantum=matching.quantum, **kept)
    assert (sensor.object_size, sensor.material) == (0.5, get_material("dark"))


@pytest.mark.parametrize(
    ("method", "setting"),
    [
        ("opencv-bm", {"texture": 3.0}),
        ("opencv-bm", {"left_right": 0.0}),
        ("opencv-bm", {"median": 3}),
        ("zncc", {"bias_correction": True}),
        ("zncc", {"ad_census": AdCensusSettings(arm=3)}),
        ("ad-census", {"bias_correction": True}),
        ("ad-census", {"uniqueness": 0.1}),
        ("ad-census", {"correlation": 0.6}),
    ],
)
def test_a_setting_that_the_matcher_never_reads_is_refused(method, setting):
    with pytest.raises(
        InputError, match=f"{method} never reads {next(iter(setting))}; leave it out"
    ):
        MatchingSettings(method, 64, 9, **setting)
    readers = {*get_args(Method)} - {method}
    taken = []
    for reader in readers:
        with contextlib.suppress(InputError):
            taken.append(MatchingSettings(reader, 64, 9, **setting))
    assert taken


def test_settings_of_a_scan_that_its_matcher_never_reads_are_refused():
    for sensor in ("d435", "kinect-v1", ("paper", "d435")):
        with pytest.raises(InputError, match="never reads bias_correction"):
            _ = [s.make_sensor() for s in ScanSettings(sensor, bias_correction=True).each_sensor()]
    corrected = ScanSettings("d435", matching="opencv-bm", bias_correction=True).make_sensor()
    assert corrected.matching.bias_correction


# Of each class how its messages begin, and faults as TOML; behind a bar what the message says
# where it is not the first field's name alone.
FAULTS = {
    AdCensusSettings: """matching:
        census_width = 8; lambda_ad = -1.0; arm = 16; penalty_small = 6.0; edge = nan
        corrections = -1; grain = 0.0""",
    MatchingSettings: """matching:
        method = 'sgm'; num_disparities = 50; num_disparities = 2000, method = 'zncc'
        block_size = 8; block_size = 33, method = 'zncc'; left_band = 'none'
        quantum = 0.0625, bias_correction = true; correlation = nan; median = 4""",
    ExposureSettings: """exposure:
        gain = inf; auto = 1.0; max_gain = -1.0; psf = nan; speckle = -1.0; offset = 300.0
        response = 'log' | response 'log'; choose; bits = 12 | bits 12; choose""",
    PatternSettings: """pattern:
        columns = 31 | multiples of 3; rows = 0 | multiples of 3; spot_size = 0.0; spot_size = 2.5
        kind = 'rosettes', columns = 630, rows = 498 | multiples of 15; tan_half_width = 0.0
        tan_half_height = nan; seed = -1; columns = 3000000; tan_half_height = 1e6""",
    SceneSettings: """scene:
        layout = 'kitchen' | kitchen.*alone, floor; layout = 'alone+floor' | alone does not
        layout = 'behind+beside' | not both; wall_gap = -1.0; neighbour_size = 0.0; cover = 1.5
        arc = 200.0""",
    Placement: """placement:
        radius = [0.0, 1.0]; radius = [nan, 1.0]; elevation = [50.0, 20.0]; radius = 1.0""",
    DepthSettings: "depth: near = 1.0, far = 1.0; far = inf; stride = -4",
    StereoRig: """rig:
        width = 100000 | a film of 100000 × 1080 pixels
        baseline = 50.0 | baseline 50 is in metres""",
    ScanSettings: """scan|camera:
        num_points = 0; samples = 0; seed = -1; views = 257; num_points = 'x' | 'x' must be a whole
        num_points = 10000000 | num_points 10000000 must be .* at most 1000000
        num_points = 1e12 | num_points 1000000000000.0 must be a whole number
        num_points = true | num_points True must be a whole number
        samples = 1000000000 | samples 1000000000 must be .* at most 65536""",
    Material: """material:
        metallic = 1.0 | diffuse never reads metallic; .* model principled$
        roughness = 0.1, model = 'mirror'; ior = 1.3, model = 'mirror'; ior = 1.3
        albedo = 0.5, model = 'glass'; albedo = 1.5""",
    LightSettings: "light: sky_elevation = nan; sky_elevation = 91.0; ambient = -1.0; sky = inf",
    CyclesRenderer: "renderer: samples = 0; max_bounces = -1; samples = 1000000000",
    MitsubaRenderer: """renderer:
        samples = 0; max_depth = 0; cache_cell = 0; cache_rays = 0; cache_rays = 1000000000
        max_depth = 1000000000""",
}


@pytest.mark.parametrize("kind", FAULTS)
def test_each_fault_is_named_in_one_line_before_anything_is_allocated(kind):
    room, _, faults = FAULTS[kind].partition(":")
    for text in re.split(r"\n|; (?=\w+ =)", faults.strip()):
        fault, _, words = text.strip().partition(" | ")
        changes = tomllib.loads(f"all = {{{fault}}}")["all"]
        settings = kind()
        for name, value in changes.items():
            object.__setattr__(settings, name, value)  # past the tests' own check of types
        message = f"^({room}): .*{words or next(iter(changes))}"
        with pytest.raises(InputError, match=message) as error:
            settings.__post_init__()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(("name", "value"), [("variant", "scalar_rgb"), ("indirect", "path")])
def test_a_renderer_refuses_what_is_anothers(name, value):
    with pytest.raises(InputError, match=f"{name}: {value} is Mitsuba's"):
        ScanSettings(renderer="cycles", **{name: value}).make_renderer()


@pytest.mark.parametrize(
    "changes", [{"samples": 16}, {"indirect": "path", "variant": "scalar_rgb"}]
)
def test_a_renderer_object_has_its_own_settings(changes):
    """They would be ignored. Those of a named renderer go into its object."""
    renderer = MitsubaRenderer(variant="scalar_rgb", samples=2)
    with pytest.raises(InputError, match=f"{', '.join(changes)}: .* renderer object"):
        ScanSettings(renderer=renderer, **changes).make_renderer()
    made = ScanSettings(**changes).with_renderer()
    assert made.make_renderer() == ScanSettings(**changes).make_renderer()


@pytest.mark.parametrize(("name", "meant"), [("blender", ""), ("mitsubba", "mitsuba")])
def test_an_unknown_renderer_is_an_error(name, meant):
    settings = ScanSettings()
    object.__setattr__(settings, "renderer", name)  # past the tests' own check of types
    with pytest.raises(InputError, match=f"renderer: no '{name}'.*{meant}.*mitsuba, cycles"):
        settings.__post_init__()


def test_each_scan_draws_one_of_several_sensors_and_a_number_of_views_evenly():
    names = ("d415", "d435", "d455", "kinect-v1")
    settings = ScanSettings(sensor=names, views=5, least_views=1)
    several = [choose(settings, np.random.default_rng(seed)) for seed in range(200)]
    for name, values in {"sensor": names, "views": (1, 2, 3, 4, 5)}.items():
        counts = collections.Counter(drawn[name] for _, drawn in several)
        assert set(counts) == set(values)
        assert stats.chisquare(list(counts.values())).pvalue > 0.01
    for chosen, drawn in several[:50]:
        assert chosen.make_sensor() == SENSORS[drawn["sensor"]]
        assert (chosen.views, chosen.least_views) == (drawn["views"], None)
    one = dataclasses.replace(settings, sensor="d435")  # neither depends on the other
    same = [choose(one, np.random.default_rng(seed))[1] for seed in range(50)]
    assert same == [{"views": drawn["views"]} for _, drawn in several[:50]]
    assert choose(ScanSettings(), np.random.default_rng(0)) == (ScanSettings(), {})


def test_several_sensors_are_recorded_and_refused_where_one_is_needed():
    settings = ScanSettings(sensor=("d435", SENSORS["kinect-v1"]), randomise="rooms")
    alone = [dataclasses.replace(settings, sensor=name) for name in ("d435", "kinect-v1")]
    assert settings.as_dict()["randomise"] == [one.as_dict()["randomise"] for one in alone]
    assert (settings.real_size, settings.needs_neighbour) == ("class", True)
    with pytest.raises(InputError, match=r"several are given \(d435, kinect-v1\); name one"):
        settings.make_sensor()
    for views, least in ((2, 3), (2, 0)):
        with pytest.raises(InputError, match="least_views"):
            ScanSettings(views=views, least_views=least)
