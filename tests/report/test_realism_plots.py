import dataclasses

import numpy as np
import pytest

from qs3.report.figure import png_bytes
from qs3.report.realism import REALISM_PLOTS, realism_plot
from qs3.sensor.presets import SENSORS

D435 = SENSORS["d435"]
Z = [0.4, 0.8, 1.6, 3.0]
DATA = {
    "T1": {
        "z": Z,
        "rms_mm": [2.0 * z**2 for z in Z],
        "subpixel_rms": [0.05] * 4,
        "fill": [1.0] * 4,
    },
    "T2": {"fraction": [0.75, 0.25, 0.5], "bias": [0.03, -0.02, None]},
    "T5": {
        "offset": [-1.5, -0.5, 0.5, 1.5],
        "near_share": [1.0, 0.9, 0.4, 0.0],
        "between_share": [0.0, 0.0, 0.1, 0.0],
    },
    "T6": {
        "albedo": [0.6, 0.2, 0.02],
        "fill_albedo": [1.0, 0.8, 0.1],
        "angle": [0.0, 50.0, 80.0],
        "fill_angle": [1.0, 0.9, None],
    },
    "T8": {
        "z": Z,
        "step_mm": [3.0, 6.0, 9.0, 12.0],
        "step_law_mm": [2.85 * z**2 for z in Z],
        "sigma_mm": [1.0, 2.0, 3.0, 4.0],
        "sigma_law_mm": [1.43 * z**2 for z in Z],
    },
    "T10": {"distance": [-1.0, 0.0, 1.0], "share": [0.2, 0.5, 0.3]},
}


def result(test: str, **changes) -> dict:
    made = {"id": test, "title": test, "passed": True, "rows": [], "data": DATA.get(test, {})}
    return made | changes


def lines(figure, panel: int = 0) -> dict:
    return {line.get_label(): line for line in figure.axes[panel].lines}


def test_every_plot_is_drawn():
    for test in REALISM_PLOTS:
        assert len(png_bytes(realism_plot(result(test), D435), dpi=30)) > 1000
    assert len(set(REALISM_PLOTS.values())) == len(REALISM_PLOTS)


@pytest.mark.parametrize("test", ["T3", "T7"])
def test_a_test_without_a_plot_has_none(test):
    assert realism_plot(result(test, data={"x": [1.0]}), D435) is None


def test_a_test_that_does_not_apply_has_none():
    assert realism_plot(result("T8", data={}, passed=None), D435) is None


def test_noise_stands_beside_the_law_and_its_slope():
    figure = realism_plot(result("T1"), D435)
    drawn = lines(figure)
    np.testing.assert_array_equal(drawn["measured"].get_xydata(), np.c_[Z, DATA["T1"]["rms_mm"]])
    fit = drawn["fit: slope 2.00"]
    np.testing.assert_allclose(fit.get_ydata(), 2.0 * fit.get_xdata() ** 2)
    (law,) = (line for name, line in drawn.items() if name.startswith("law"))
    focal_baseline = D435.rig.focal * D435.rig.baseline
    np.testing.assert_allclose(law.get_ydata(), 80.0 * law.get_xdata() ** 2 / focal_baseline)
    axes = figure.axes[0]
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("distance [m]", "RMS about the plane [mm]")


def test_lengths_of_a_sensor_without_metres_are_sizes_of_the_object():
    axes = realism_plot(result("T1"), SENSORS["paper"]).axes[0]
    assert "object" in axes.get_xlabel()
    assert "mm" not in axes.get_ylabel()


def test_a_wall_without_a_value_leaves_the_fit_alone():
    data = DATA["T1"] | {"rms_mm": [2.0 * Z[0] ** 2, None, 2.0 * Z[2] ** 2, 2.0 * Z[3] ** 2]}
    drawn = lines(realism_plot(result("T1", data=data), D435))
    assert "fit: slope 2.00" in drawn
    assert np.isnan(drawn["measured"].get_ydata()).sum() == 1
    nothing = DATA["T1"] | {"rms_mm": [None] * 4}
    png_bytes(realism_plot(result("T1", data=nothing), D435))


def test_bias_is_in_order_of_the_fraction_with_the_median_and_its_bounds():
    rows = [{"what": "median disparity error", "measured": 0.004}]
    figure = realism_plot(result("T2", rows=rows), D435)
    drawn = lines(figure)
    np.testing.assert_array_equal(drawn["mean of a wall"].get_xdata(), [0.25, 0.5, 0.75])
    np.testing.assert_array_equal(drawn["mean of a wall"].get_ydata(), [-0.02, np.nan, 0.03])
    assert drawn["median of all: +0.0040 px"].get_ydata()[0] == 0.004
    (band,) = figure.axes[0].patches
    assert band.get_bbox().intervaly.tolist() == [-0.01, 0.01]
    low, high = figure.axes[0].get_ylim()
    assert low < -0.02 and high > 0.03


@pytest.mark.parametrize(("method", "most"), [("zncc", 5.5), ("ad-census", 2.5)])
def test_the_edge_is_marked_by_what_the_matcher_may_be_off(method, most):
    block = dataclasses.replace(D435.matching, method=method, block_size=11)
    figure = realism_plot(result("T5"), dataclasses.replace(D435, matching=block))
    drawn = lines(figure)
    np.testing.assert_array_equal(drawn["depth of the plate"].get_ydata(), DATA["T5"]["near_share"])
    np.testing.assert_array_equal(
        drawn["depth in between"].get_ydata(), DATA["T5"]["between_share"]
    )
    (band,) = figure.axes[0].patches
    assert band.get_bbox().intervalx.tolist() == [-most, most]


def test_fill_gets_darker_and_more_glancing_to_the_right():
    figure = realism_plot(result("T6"), D435)
    albedo, angle = figure.axes
    for axes, name in ((albedo, "albedo"), (angle, "angle")):
        (line,) = axes.lines
        np.testing.assert_array_equal(line.get_xdata(), DATA["T6"][name])
        known = [np.nan if v is None else v for v in DATA["T6"][f"fill_{name}"]]
        np.testing.assert_array_equal(line.get_ydata(), known)
    assert albedo.get_xlim()[0] > albedo.get_xlim()[1]
    assert angle.get_xlim()[0] < angle.get_xlim()[1]


def test_steps_stand_beside_the_laws_with_their_bounds():
    figure = realism_plot(result("T8"), SENSORS["kinect-v1"])
    drawn = lines(figure)
    for name, what in (("step", "step of depth"), ("sigma", "noise σ")):
        measured, law = DATA["T8"][f"{name}_mm"], DATA["T8"][f"{name}_law_mm"]
        np.testing.assert_array_equal(drawn[f"{what}: measured"].get_ydata(), measured)
        np.testing.assert_array_equal(drawn[f"{what}: law ± 20 %"].get_ydata(), law)
    top = figure.axes[0].collections[0].get_paths()[0].vertices[:, 1].max()
    assert top == pytest.approx(1.2 * max(DATA["T8"]["step_law_mm"]))


def test_distances_stand_beside_a_gaussian_of_the_same_area():
    figure = realism_plot(result("T10"), D435)
    bars = figure.axes[0].containers[0]
    assert [bar.get_height() for bar in bars] == DATA["T10"]["share"]
    assert {bar.get_width() for bar in bars} == {1.0}
    (curve,) = figure.axes[0].lines
    assert max(curve.get_ydata()) == pytest.approx(1 / np.sqrt(2 * np.pi), rel=1e-3)
