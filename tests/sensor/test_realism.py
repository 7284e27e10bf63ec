"""Each law passes arrays that are right and misses arrays of a known error."""

import math

import numpy as np
import pytest

from qs3.sensor.presets import load_sensor
from qs3.sensor.realism import autocorrelation, off_plane
from qs3.sensor.rig import StereoRig
from qs3.sensor.view import ViewImages

from .laws import edges, faces, walls
from .laws.bench import Bench
from .laws.edges import band_row, edge_rows, shadow_row
from .laws.faces import inside_faces, off_faces, scan_rows
from .laws.metrics import plane_noise
from .laws.walls import bias_rows, noise_rows, phases

RIG = StereoRig(width=200, height=160, focal=430.0, baseline=0.05)
Z = (0.4, 0.7, 1.2, 2.0, 3.0)


def passed(rows) -> bool:
    return not missed(rows)


def missed(rows) -> list[str]:
    return [figure["what"] for figure in rows if figure["passed"] is False]


def wall_disparity(z, sigma, rng, rig=RIG, quantum=1 / 32, bias=0.0):
    disparity = rig.disparity(z) + bias + sigma * rng.standard_normal((rig.height, rig.width))
    return np.rint(disparity / quantum) * quantum


def wall_depth(*args, **kwargs):
    return RIG.focal * RIG.baseline / wall_disparity(*args, **kwargs)


# The metrics themselves


def test_plane_noise_gives_back_the_noise_that_was_put_in():
    rng = np.random.default_rng(0)
    z, sigma = 1.2, 0.07
    depth = RIG.focal * RIG.baseline / wall_disparity(z, sigma, rng, quantum=1e-9)
    rms, pixels = plane_noise(depth, RIG, RIG.full_frame)
    # A normal distribution without its outer 0.5 % on either side.
    t = 2.5758
    cut = math.sqrt(1 - 2 * t * math.exp(-t * t / 2) / math.sqrt(2 * math.pi) / 0.99)
    y, x = np.indices(depth.shape)
    cx, cy = RIG.principal_point
    ray = np.sqrt(1 + ((x - cx) ** 2 + (y - cy) ** 2) / RIG.focal**2)
    law = z**2 * sigma / (RIG.focal * RIG.baseline)
    assert rms == pytest.approx(cut * law, rel=0.02)
    # The tool divides by the length of the ray in place of z, and moves along the normal.
    along = np.sqrt(np.mean(ray**-6.0))
    assert pixels == pytest.approx(cut * sigma * along, rel=0.01)


# T1


@pytest.mark.parametrize(
    ("sigma", "misses"),
    [
        (lambda z: 0.07, []),
        (lambda z: 0.15, ["least sub-pixel RMS", "greatest sub-pixel RMS"]),
        (lambda z: 0.07 * z**-0.3, ["log-log slope of RMS over distance"]),
    ],
)
def test_t1_wants_the_square_law_and_a_real_sensors_noise(sigma, misses):
    rng = np.random.default_rng(1)
    seen = [plane_noise(wall_depth(z, sigma(z), rng), RIG, RIG.full_frame) for z in Z]
    assert missed(noise_rows(Z, np.array(seen))) == misses


def test_autocorrelation_separates_blurred_from_sharp_noise():
    rng = np.random.default_rng(8)
    sharp = wall_disparity(1.0, 0.1, rng, quantum=1e-9)
    blurred = np.mean([np.roll(sharp, shift, axis=1) for shift in range(8)], axis=0)[:, 8:]
    for error, alike in ((sharp, (0, 0, 0)), (blurred, (7 / 8, 1 / 2, 0))):
        sloped = error + 0.003 * np.arange(error.shape[1])  # a slope is no error
        sloped[0, :5] = np.nan
        found = autocorrelation(off_plane(sloped), (1, 4, 8))
        np.testing.assert_allclose(found, alike, atol=0.05)
    assert np.isnan(autocorrelation(off_plane(np.full((4, 9), np.nan)), (1,))).all()


# T2


@pytest.mark.parametrize(
    ("bias", "good"), [(0.0, True), (0.02, False), (-0.02, False), (1 / 32, False)]
)
def test_t2_finds_a_bias_of_a_fiftieth_of_a_pixel(bias, good):
    rng = np.random.default_rng(2)
    sweep = phases(RIG, 1.0, 15)
    seen = [wall_disparity(z, 0.06, rng, bias=bias).ravel() for z in sweep]
    true = [float(RIG.disparity(z)) for z in sweep]
    assert passed(bias_rows(seen, true)) is good
    np.testing.assert_allclose(np.sort(np.mod(true, 1)), (np.arange(15) + 0.5) / 15, atol=1e-9)


# T4


@pytest.mark.parametrize(("width", "good"), [(21, True), (22, True), (19, False), (24, False)])
def test_t4_measures_the_left_band(width, good):
    disparity = np.full((30, 100), 21.4)
    disparity[:, :width] = np.nan
    assert band_row(disparity, 21.4)["passed"] is good


def edge_scene(left=60, right=120, near=36.0, far=21.5, shadow=15, grow=0):
    """A plate in columns left … right − 1 before a wall, with its shadow at the left."""
    disparity = np.full((40, 180), far)
    disparity[:, left - shadow : left] = np.nan
    disparity[:, left - grow : right + grow] = near
    return disparity


@pytest.mark.parametrize(("shadow", "good"), [(15, True), (21, True), (3, False), (26, False)])
def test_t4_measures_the_shadow_beside_an_edge(shadow, good):
    measured = shadow_row(edge_scene(shadow=shadow), 60, 36.0, 21.5, 8.5)
    assert measured["measured"] == shadow
    assert measured["passed"] is good


def test_t4_sees_the_shadow_through_a_fattened_edge_and_not_right_of_the_plate():
    assert shadow_row(edge_scene(grow=5), 60, 36.0, 21.5, 8.5)["measured"] == 15
    swapped = edge_scene()[:, ::-1]  # the shadow on the wrong side
    assert not shadow_row(swapped, 60, 36.0, 21.5, 8.5)["passed"]


# T5


@pytest.mark.parametrize(("grow", "good"), [(0, True), (8, True), (9, False), (12, False)])
def test_t5_measures_fattening_on_both_sides(grow, good):
    rows = edge_rows(edge_scene(grow=grow), (60, 119), 36.0, 34, 8.5)
    assert [figure["measured"] for figure in rows] == [grow, grow]
    assert passed(rows) is good


def test_t5_misses_an_eroded_plate():
    assert len(missed(edge_rows(edge_scene(left=72, right=108), (60, 119), 36.0, 34, 8.5))) == 2


# T10


@pytest.mark.parametrize(
    ("scale", "shift", "good"),
    [(1.0, 0.0, True), (1.2, 0.0, True), (1.4, 0.0, False), (0.6, 0.0, False), (1.0, 0.3, False)],
)
def test_t10_wants_the_law(scale, shift, good):
    rng = np.random.default_rng(6)
    ratio = shift + scale * rng.standard_normal(20_000)
    assert passed(scan_rows(ratio)) is good


def test_t10_measures_faces_in_units_of_the_law():
    rng = np.random.default_rng(7)
    z, sigma = 1.5, 0.08
    true = np.full((RIG.height, RIG.width), z)
    true[:, 100:] = 1.2  # two faces with an edge between them
    noise = sigma * rng.standard_normal(true.shape)
    depth = RIG.focal * RIG.baseline / (RIG.disparity(true) + noise)
    normals = np.zeros((*true.shape, 3))
    normals[..., 2] = -1
    grey = np.zeros(true.shape, np.uint8)
    shown = np.ones(true.shape, bool)
    view = ViewImages(RIG.full_frame, grey, grey, noise.astype(np.float32), depth, true, shown,
                      normals=normals)  # fmt: skip
    walls = np.array([1.0, 2.0])
    assert passed(scan_rows(off_faces(view, RIG, 17, walls, [sigma, sigma])))
    assert not passed(scan_rows(off_faces(view, RIG, 17, walls, [0.04, 0.04])))
    # No pixel near the edge between the faces.
    ray = np.ones((*true.shape, 3))
    ray[..., :2] = 0
    kept = inside_faces(view, ray, 10)
    assert not kept[:, 90:110].any()
    assert kept[20:140, 20:89].all()


# All of them


LAWS = {
    "T1": walls.noise,
    "T2": walls.bias,
    "T4": edges.bands,
    "T5": edges.edges,
    "T10": faces.scanned,
    "T11": faces.strays,
}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_the_d435_keeps_the_law(law, renderer):
    assert missed(LAWS[law](Bench(load_sensor("d435"), renderer))) == []
