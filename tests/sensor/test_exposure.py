import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg, stats

from qs3.sensor.exposure import ExposureSettings, blur, blur_reach, expose, expose_pair
from qs3.sensor.light import StereoPair
from qs3.sensor.presets import load_sensor
from qs3.sensor.rig import Pose, Region, StereoRig
from qs3.sensor.view import photograph

RIG = StereoRig(width=201, height=161, focal=100.0)
OBJECT = Region(40, 30, 110, 90)
LINEAR = ExposureSettings(response="linear")
EVERYTHING = ExposureSettings(
    response="film", auto=0.6, psf=1.2, speckle=200.0, noise=2.0, offset=-0.5
)


def pair_of(left, right=None, where=RIG.full_frame, background=0.05) -> StereoPair:
    right = left if right is None else right
    left, right = (np.asarray(image, np.float32) for image in (left, right))
    return StereoPair(left, right, where, where, background, Pose(np.eye(4)))


def textured(seed=0, scale=1.0) -> StereoPair:
    """An object of uneven radiance before an even background."""
    rng = np.random.default_rng(seed)
    left, right = (scale * rng.gamma(2.0, 0.2, (2, OBJECT.height, OBJECT.width))).astype(np.float32)
    return pair_of(left, right, OBJECT, 0.05 * scale)


def exposed(pair, settings, seed=0, canvas=RIG.full_frame, focus=OBJECT, rig=RIG):
    return expose_pair(pair, canvas, focus, rig, settings, np.random.default_rng(seed))


# Responses


def test_film_is_a_logistic_curve_of_the_logarithm():
    light = np.geomspace(1e-4, 1e3, 300)[None]
    logistic = 1 / (1 + np.exp(-0.756 * np.log(light / 0.18)))
    np.testing.assert_array_equal(expose(light, ExposureSettings()), np.rint(255 * logistic))


def test_ten_bits_hold_the_eight():
    for settings in (LINEAR, EVERYTHING):
        fine = exposed(textured(), dataclasses.replace(settings, bits=10))
        coarse = exposed(textured(), settings)
        for ten, eight in zip(fine, coarse, strict=True):
            assert (ten.dtype, eight.dtype) == (np.uint16, np.uint8)
            assert np.abs((ten >> 2).astype(int) - eight).max() <= 1
            np.testing.assert_allclose(ten / 1023, eight / 255, atol=0.5 / 255 + 0.5 / 1023)


# Speckle and noise


def test_speckle_is_gamma_of_mean_one_and_the_stated_shape():
    shape, level = 50.0, 0.25
    settings = ExposureSettings(response="linear", speckle=shape, bits=10)
    pair = pair_of(np.full((400, 500), level), where=Region(0, 0, 500, 400))
    rig = StereoRig(width=500, height=400, focal=500.0)
    left, right = exposed(pair, settings, canvas=rig.full_frame, rig=rig)
    for grey in (left, right):
        factor = grey / 1023 / level
        count = factor.size
        variance = 1 / shape + 1 / 12 / (1023 * level) ** 2
        kurtosis = 3 + 6 / shape
        assert factor.mean() == pytest.approx(1, abs=4 * np.sqrt(variance / count))
        error = 4 * variance * np.sqrt((kurtosis - 1) / count)
        assert factor.var() == pytest.approx(variance, abs=error)
        assert stats.skew(factor.ravel()) == pytest.approx(2 / np.sqrt(shape), rel=0.1)
    assert abs(np.corrcoef(left.ravel(), right.ravel())[0, 1]) < 0.01
    assert abs(np.corrcoef(left[:, 1:].ravel(), left[:, :-1].ravel())[0, 1]) < 0.01


def test_coherent_speckle_spares_the_rooms_light():
    settings = ExposureSettings(response="linear", coherent=4.0, bits=10)
    room, dots = np.full((161, 201), 0.2), np.zeros((161, 201))
    dots[:, :100] = 0.1
    pair = dataclasses.replace(pair_of(room + dots), room=pair_of(room))
    left, right = exposed(pair, settings)
    for grey in (left, right):
        assert (grey[:, 100:] == round(1023 * 0.2)).all()
        factor = (grey[:, :100] / 1023 - 0.2) / 0.1
        assert factor.mean() == pytest.approx(1, abs=0.02)
        assert factor.std() == pytest.approx(0.5, rel=0.03)
    assert abs(np.corrcoef(left[:, :100].ravel(), right[:, :100].ravel())[0, 1]) < 0.03
    with pytest.raises(ValueError, match="projector"):
        exposed(pair_of(room), settings)


@pytest.mark.parametrize("coherent", [0.0, 4.0])
def test_a_view_is_taken_without_the_projector_where_speckle_needs_it(coherent):
    lit = []

    def render(scene, rig, poses, seeds, regions=None):
        lit.append((scene.light.projector, *seeds))
        return [pair_of(np.full((2, 2), scene.light.projector)) for _ in poses]

    lamp = SimpleNamespace(description={}, render=render)
    sensor = dataclasses.replace(load_sensor("d415"), exposure=ExposureSettings(coherent=coherent))
    pose = Pose(np.eye(4))
    pairs = photograph(lamp, (), sensor, [pose] * 2, [3, 4])
    assert [pair.left.max() for pair in pairs] == [1.0, 1.0]
    assert lit == ([(1.0, 3, 4), (0.0, 3, 4)] if coherent else [(1.0, 3, 4)])
    assert all((pair.room is None) == (coherent == 0) for pair in pairs)
    assert not any(pair.room.left.any() for pair in pairs if pair.room)


def test_noise_has_the_mean_and_size_asked_for():
    settings = ExposureSettings(response="linear", noise=3.0, offset=-7.25)
    left, right = (
        grey.astype(float) for grey in exposed(pair_of(np.full((161, 201), 0.5)), settings)
    )
    for grey in (left, right):
        assert grey.mean() == pytest.approx(127.5 - 7.25, abs=4 * 3 / np.sqrt(grey.size))
        assert grey.std() == pytest.approx(np.hypot(3.0, 1 / np.sqrt(12)), rel=0.02)
    assert abs(np.corrcoef(left.ravel(), right.ravel())[0, 1]) < 0.03


# Auto-exposure


@pytest.mark.parametrize("response", ["film", "linear"])
@pytest.mark.parametrize("scale", [0.01, 40.0])
def test_auto_exposure_brings_the_percentile_to_its_share(response, scale):
    settings = ExposureSettings(response=response, auto=0.6)
    left, _ = exposed(textured(scale=scale), settings)
    shown = left[OBJECT.slices]
    assert np.percentile(shown, 95, method="nearest") == pytest.approx(0.6 * 255, abs=1)


def test_both_cameras_have_one_gain():
    pair = textured()
    darker = dataclasses.replace(pair, right=pair.left / 4)
    left, right = exposed(darker, ExposureSettings(response="linear", auto=0.5, bits=10))
    inside = left[OBJECT.slices]
    cut = inside < 1023
    np.testing.assert_allclose(right[OBJECT.slices][cut], inside[cut] / 4, atol=0.63)


def test_auto_exposure_looks_at_the_object_and_not_at_the_background():
    settings = ExposureSettings(auto=0.5, psf=0.8)
    around = [OBJECT, OBJECT.grown(30, 201, 161), RIG.full_frame]
    greys = [exposed(textured(), settings, focus=focus)[0] for focus in around]
    for grey in greys[1:]:
        np.testing.assert_array_equal(grey, greys[0])


def test_auto_exposure_has_a_largest_gain():
    settings = ExposureSettings(response="linear", auto=0.6, max_gain=2.0)
    dark = textured(scale=0.02)
    fixed = exposed(dark, ExposureSettings(response="linear", gain=2.0))
    np.testing.assert_array_equal(exposed(dark, settings), fixed)
    bright = exposed(textured(), settings)
    np.testing.assert_array_equal(bright, exposed(textured(), ExposureSettings("linear", auto=0.6)))


@pytest.mark.parametrize("focus", [OBJECT, Region(0, 0, 0, 0), Region(0, 0, 20, 20)])
def test_auto_exposure_of_nothing_is_defined(focus):
    black = pair_of(np.zeros((161, 201)), background=0.0)
    left, right = exposed(black, ExposureSettings(auto=0.6, psf=1.0), focus=focus)
    assert not left.any()
    assert not right.any()


# The lens


@pytest.mark.parametrize("psf", [0.5, 3.0])
def test_blur_solves_the_heat_equation_on_the_pixels(psf):
    image = np.random.default_rng(0).random((80, 90), dtype=np.float32)
    down, across = (
        linalg.expm(psf**2 / 2 * (np.eye(n, k=1) - 2 * np.eye(n) + np.eye(n, k=-1)))
        for n in image.shape
    )
    rim = 2 * blur_reach(psf)
    inner = (slice(rim, -rim), slice(rim, -rim))
    np.testing.assert_allclose(blur(image, psf)[inner], (down @ image @ across)[inner], atol=1e-4)


@pytest.mark.parametrize("bits", [8, 10])
def test_grey_levels_do_not_depend_on_the_canvas(bits):
    settings = dataclasses.replace(EVERYTHING, bits=bits)
    whole = exposed(textured(), settings)
    for canvas in (
        Region(60, 50, 40, 31),
        Region(0, 0, 33, 27),
        Region(150, 100, 51, 61),
        Region(1, 40, 199, 3),
        Region(77, 80, 1, 1),
    ):
        part = exposed(textured(), settings, canvas=canvas)
        for full, cut in zip(whole, part, strict=True):
            np.testing.assert_array_equal(cut, full[canvas.slices])
