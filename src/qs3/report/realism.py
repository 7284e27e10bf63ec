"""The test of a simulated camera in its folder: a record to go on from after a stop, and plots."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

from qs3.errors import InputError
from qs3.evaluation import versions
from qs3.files import claim_folder, read_json, write_json
from qs3.report.figure import NO_VALUE, PALETTE, house_style, write_png
from qs3.sensor.presets import Sensor, sensor_name, settings_dict
from qs3.sensor.realism import RealismSettings, realism
from qs3.sensor.realism.edges import allowed
from qs3.sensor.render import Renderer
from qs3.sensor.settings import renderer_dict
from qs3.structure import fill, first_difference, unstructure

RECORD = "realism.json"

LAW_PIXELS = 0.08
"""Sub-pixel RMS of the law of noise: a well-lit wall, Intel's guide to tuning depth cameras."""

_WIDTH = 5.2
_MEASURED, _LAW, _SECOND = PALETTE[0], PALETTE[6], PALETTE[2]
_Result = Mapping[str, Any]


def realism_plot(result: _Result, sensor: Sensor) -> Figure | None:
    """Draw a result of `qs3.sensor.realism.realism`; None where it has no plot or did not apply."""
    if result["id"] not in _DRAW or not result["data"]:
        return None
    return _DRAW[result["id"]](result, sensor)


@house_style
def rms_plot(result: _Result, sensor: Sensor) -> Figure:
    """RMS about the wall's plane against distance (T1), with the law and the fitted slope."""
    z, rms = _series(result, "z"), _series(result, "rms_mm")
    x, y = _length("distance", "m", sensor), _length("RMS about the plane", "mm", sensor)
    figure, axes = _plot(sensor, "noise of a facing wall", x, y)
    reach = np.geomspace(z.min() / 1.1, z.max() * 1.1, 50)
    law = 1000 * LAW_PIXELS * reach**2 / (sensor.rig.focal * sensor.rig.baseline)
    axes.plot(reach, law, "--", color=_LAW, label=f"law: {LAW_PIXELS} px · z²/(f·b)")
    positive = rms > 0
    if positive.sum() > 1:
        slope, start = np.polyfit(np.log(z[positive]), np.log(rms[positive]), 1)
        fitted = np.exp(start) * reach**slope
        axes.plot(reach, fitted, "-", color=NO_VALUE, label=f"fit: slope {slope:.2f}")
    axes.plot(z, rms, "o", color=_MEASURED, label="measured")
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.legend(loc="upper left")
    return figure


@house_style
def bias_plot(result: _Result, sensor: Sensor) -> Figure:
    """Mean error of disparity against its fraction of a pixel (T2), with the median's bounds."""
    fraction, bias = _series(result, "fraction"), _series(result, "bias")
    order = np.argsort(fraction)
    across = "fraction of the true disparity [px]"
    figure, axes = _plot(sensor, "bias over a pixel", across, "error of disparity [px]")
    axes.axhspan(-0.01, 0.01, color=_SECOND, alpha=0.25, label="bounds of the median")
    style = {"color": _MEASURED, "markersize": 4, "label": "mean of a wall"}
    axes.plot(fraction[order], bias[order], "o-", **style)
    median = next((r["measured"] for r in result["rows"] if "median disparity" in r["what"]), None)
    if median is not None:
        axes.axhline(median, color=_LAW, linestyle="--", label=f"median of all: {median:+.4f} px")
    reach = 1.3 * max(0.02, float(np.nanmax(np.abs(bias), initial=0.0)))
    axes.set(xlim=(0, 1), ylim=(-reach, reach))
    figure.legend(loc="outside lower center", fontsize=9, ncols=2)
    return figure


@house_style
def edge_plot(result: _Result, sensor: Sensor) -> Figure:
    """What is measured across the edge of a plate before a wall (T5), its bounds marked."""
    offset = _series(result, "offset")
    most = allowed(sensor.matching)
    across = "pixels from the true edge (left: on the plate)"
    figure, axes = _plot(sensor, "profile of an edge", across, "share of the rows")
    axes.axvspan(-most, most, color=_SECOND, alpha=0.2, label=f"± {most:g} px")
    axes.axvline(0, color="black", linewidth=0.8)
    near, between = _series(result, "near_share"), _series(result, "between_share")
    axes.plot(offset, near, "-", color=_MEASURED, label="depth of the plate")
    axes.plot(offset, between, "--", color=_LAW, label="depth in between")
    axes.set(xlim=(offset.min(), offset.max()), ylim=(-0.03, 1.05))
    figure.legend(loc="outside lower center", fontsize=9, ncols=3)
    return figure


@house_style
def fill_plot(result: _Result, sensor: Sensor) -> Figure:
    """Fill rate against albedo and against the angle of incidence (T6)."""
    figure = Figure(figsize=(1.4 * _WIDTH, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    left.plot(_series(result, "albedo"), _series(result, "fill_albedo"), "o-", color=_MEASURED)
    left.set(xscale="log", xticks=_series(result, "albedo"), xlabel="albedo of a patch")
    left.invert_xaxis()
    left.xaxis.set_major_formatter("{x:g}")
    left.xaxis.set_minor_locator(NullLocator())
    left.set(ylim=(-0.03, 1.05), ylabel="share of pixels with a depth")  # of both
    right.plot(_series(result, "angle"), _series(result, "fill_angle"), "o-", color=_MEASURED)
    right.set(xticks=_series(result, "angle"), xlabel="turn of a wall [°]")
    figure.suptitle(f"{sensor.name}: darker and more glancing", fontsize=10.5)
    return figure


@house_style
def steps_plot(result: _Result, sensor: Sensor) -> Figure:
    """Depth steps and noise against distance (T8), with the measured law of the real camera."""
    z = _series(result, "z")
    x, y = _length("distance", "m", sensor), _length("step, σ", "mm", sensor)
    figure, axes = _plot(sensor, "steps and noise", x, y)
    for name, what, colour, mark in (
        ("step", "step of depth", _MEASURED, "o"),
        ("sigma", "noise σ", _LAW, "s"),
    ):
        law = _series(result, f"{name}_law_mm")
        axes.fill_between(z, 0.8 * law, 1.2 * law, color=colour, alpha=0.2, linewidth=0)
        axes.plot(z, law, "--", color=colour, label=f"{what}: law ± 20 %")
        measured = _series(result, f"{name}_mm")
        axes.plot(z, measured, mark, color=colour, label=f"{what}: measured")
    axes.set_ylim(bottom=0)
    axes.legend(loc="upper left")
    return figure


@house_style
def distances_plot(result: _Result, sensor: Sensor) -> Figure:
    """Distances of scanned points from the surface in units of the law's σ (T10)."""
    distance, share = _series(result, "distance"), _series(result, "share")
    width = float(np.median(np.diff(distance))) if len(distance) > 1 else 1.0
    across = "distance from the surface, in σ of the law"
    figure, axes = _plot(sensor, "a scanned object", across, "share of the points")
    axes.bar(distance, share, width, color=_SECOND, label="measured")
    x = np.linspace(distance.min() - width / 2, distance.max() + width / 2, 200)
    normal = width * np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    axes.plot(x, normal, "--", color=_LAW, label="the law: Gaussian of σ = 1")
    figure.legend(loc="outside lower center", fontsize=9, ncols=2)
    return figure


_DRAW: dict[str, Callable[[_Result, Sensor], Figure]] = {
    "T1": rms_plot,
    "T2": bias_plot,
    "T5": edge_plot,
    "T6": fill_plot,
    "T8": steps_plot,
    "T10": distances_plot,
}
REALISM_PLOTS = {test: f"{draw.__name__.removesuffix('_plot')}.png" for test, draw in _DRAW.items()}
"""File name of the plot of each test that has one."""


def _plot(sensor: Sensor, title: str, x: str, y: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(_WIDTH, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.set(title=f"{sensor.name}: {title}", xlabel=x, ylabel=y)
    return figure, axes


def _series(result: _Result, name: str) -> Float[np.ndarray, "n"]:
    """A curve of a result; None, JSON's word for what is not finite, becomes NaN."""
    return np.array([np.nan if v is None else v for v in result["data"][name]], dtype=np.float64)


def _length(what: str, unit: str, sensor: Sensor) -> str:
    """The label of an axis of lengths: metric, or in sizes of the object."""
    sizes = {"m": "sizes of the object", "mm": "1/1000 of the object's size"}
    return f"{what} [{unit if sensor.metric else sizes[unit]}]"


def test_camera(
    out: Path,
    sensor: Sensor,
    renderer: Renderer,
    settings: RealismSettings,
    on_result: Callable[[dict[str, Any], bool], None],
) -> list[dict[str, Any]]:
    """Test a camera; results that the folder holds already are taken from it.

    Args:
        out: New or empty folder, or one of earlier tests of the same camera.
        sensor: The sensor.
        renderer: What photographs; its settings are a dataclass.
        settings: Which tests, how thoroughly.
        on_result: Called with each result, and whether it was there before.

    Returns:
        A result for each test of ``settings``, as `qs3.sensor.realism.realism` gives them.

    Raises:
        InputError: where the folder holds something else, or tests of other settings.
    """
    made_by = {
        "sensor": settings_dict(sensor),
        "renderer": renderer_dict(renderer),
        "settings": {"quick": settings.quick, "seed": settings.seed},
        "versions": versions(),
    }
    own: Any = renderer  # a dataclass
    defaults = {
        "sensor": settings_dict(Sensor()),
        "renderer": {field.name: field.default for field in dataclasses.fields(own)},
        "settings": unstructure(RealismSettings()),
    }
    before = _earlier(Path(out) / RECORD, made_by, defaults)
    results = dict(before)
    folder = claim_folder(out, RECORD)

    def keep(result: dict[str, Any]) -> None:
        results[result["id"]] = result
        if result["id"] not in before:
            ordered = sorted(results.values(), key=lambda result: int(result["id"][1:]))
            write_json(folder / RECORD, made_by | {"tests": ordered})
        on_result(result, result["id"] in before)
        figure = realism_plot(result, sensor)
        if figure is not None:
            write_png(folder / REALISM_PLOTS[result["id"]], figure)

    write_json(folder / RECORD, made_by | {"tests": list(before.values())})
    return realism(sensor, renderer, settings, done=before, on_result=keep)


def _earlier(
    path: Path, made_by: Mapping[str, Any], defaults: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Results that lie in the folder, by id, where they are of the same settings.

    Settings that a record does not have were added since: it has their ``defaults``.
    """
    if not path.is_file():
        return {}
    record = read_json(path)
    if not isinstance(record, dict) or not isinstance(record.get("tests"), list):
        raise InputError(f"{path}: not a record of qs3 realism; name another folder for --out")
    if isinstance(record.get("sensor"), dict) and "name" in record["sensor"]:
        record["sensor"]["name"] = sensor_name(record["sensor"]["name"])
    now = unstructure(made_by)
    before = fill({name: record.get(name) for name in now}, now, unstructure(defaults))
    if difference := first_difference(before, now):
        place, was, is_now = difference
        raise InputError(
            f"{path}: of other settings ({place} was {was}, is {is_now}); name another folder "
            "for --out, or repeat the settings to go on"
        )
    return {result["id"]: result for result in record["tests"]}
