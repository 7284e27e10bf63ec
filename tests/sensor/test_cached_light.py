"""The irradiance cache against path tracing, and its two implementations against each other."""

import functools
import gc

import cv2
import numpy as np
import pytest
import trimesh

from qs3.sensor.light import Body, LightSettings, Scene
from qs3.sensor.light.cache import places
from qs3.sensor.light.embree import _turns
from qs3.sensor.light.jit import JitPhotographer
from qs3.sensor.light.materials import MATERIALS, Material
from qs3.sensor.light.mitsuba import MitsubaRenderer, best_variant, usable
from qs3.sensor.light.pattern import PatternSettings, pattern_image
from qs3.sensor.rig import Pose, Region, StereoRig
from qs3.sensor.stage.randomise import COMMON_MATERIALS

RIG = StereoRig(width=120, height=96, focal=156.0, baseline=0.1)
POSE = Pose.looking_at(np.array([2.0, 1.0, 1.6]), np.zeros(3))
CORNER = trimesh.util.concatenate(
    [
        trimesh.creation.box((1.0, 1.0, 0.1)),
        trimesh.creation.box((0.1, 1.0, 0.8)).apply_translation((-0.4, 0, 0.4)),
        trimesh.creation.box((0.2, 0.2, 0.3)).apply_translation((0.1, 0.1, 0.2)),
    ]
)
needs_llvm = pytest.mark.skipif(
    not usable("llvm_ad_mono"), reason="no libLLVM that Mitsuba can use on this machine"
)
VARIANTS = [pytest.param("llvm_ad_mono", marks=needs_llvm), "scalar_rgb"]


def corner(material: Material | None = None, light: LightSettings | None = None) -> Scene:
    pattern = pattern_image(PatternSettings(columns=99, rows=99))
    body = Body(CORNER, material or Material())
    return Scene((body,), light or LightSettings(), pattern, 0.5, 0.5)


def pair(scene, variant, regions=None, rig=RIG, seed=3, **settings):
    renderer = MitsubaRenderer(variant=variant, **settings)
    return renderer.render(scene, rig, [POSE], [seed], regions)[0]


def smooth(image):
    """Means over blocks of 5 × 5 pixels."""
    high, wide = image.shape[0] // 5 * 5, image.shape[1] // 5 * 5
    return image[:high, :wide].reshape(high // 5, 5, wide // 5, 5).mean(axis=(1, 3))


@pytest.mark.parametrize(
    ("variant", "max_depth"),
    [
        pytest.param("llvm_ad_mono", 2, marks=needs_llvm),
        pytest.param("llvm_ad_mono", 3, marks=needs_llvm),
        ("scalar_rgb", 3),
    ],
)
def test_convention_cached_light_is_path_traced_light(variant, max_depth):
    scene, frame = corner(), [RIG.full_frame]
    cached = pair(scene, variant, frame, samples=16, cache_rays=128, max_depth=max_depth)
    spp = 256 if variant.startswith("llvm") else 64
    traced = pair(scene, variant, frame, samples=spp, max_depth=max_depth, indirect="path")
    for ours, theirs in ((cached.left, traced.left), (cached.right, traced.right)):
        assert ours.shape == theirs.shape
        assert ours.mean() == pytest.approx(theirs.mean(), rel=0.005)
        error = smooth(ours) - smooth(theirs)
        assert np.sqrt((error**2).mean()) < 0.03 * smooth(theirs).max()
        shift, _ = cv2.phaseCorrelate(ours.astype(np.float64), theirs.astype(np.float64))
        assert np.abs(shift).max() < 0.05


@pytest.mark.parametrize("samples", [1, 4, 7, 64])
def test_rays_of_a_pixel_form_a_latin_square_about_its_centre(samples):
    steps = (np.arange(samples) + 0.5) / samples
    for axis in places(samples).T:
        np.testing.assert_allclose(np.sort(axis), steps, rtol=1e-6)
        assert axis.mean() == pytest.approx(0.5, abs=1e-6)


@needs_llvm
@pytest.mark.parametrize(
    ("name", "rays", "max_depth"),
    # Light from the projector by way of gloss (caustics) is rare and bright, thus compared nowhere.
    [("diffuse", 512, 3), *((name, 128, 2) for name in COMMON_MATERIALS[1:])],
)
def test_both_implementations_agree(name, rays, max_depth):
    scene, settings = corner(MATERIALS[name]), {"cache_rays": rays, "max_depth": max_depth}
    jit = pair(scene, "llvm_ad_mono", samples=4, **settings)
    embree = pair(scene, "scalar_rgb", samples=4, **settings)
    for ours, theirs in ((jit.left, embree.left), (jit.right, embree.right)):
        assert np.median(np.abs(ours - theirs)) < 2e-3
        assert (np.abs(ours - theirs) > 0.05).mean() < 0.005


@functools.cache
def traced_mean(roughness, max_depth):
    """Of the path, by the fastest variant: of every variant's cache it is the law."""
    scene, variant = corner(Material("principled", roughness=roughness)), best_variant()
    spp = 256 if variant.startswith("llvm") else 128
    return pair(scene, variant, samples=spp, indirect="path", max_depth=max_depth).right.mean()


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("roughness", "max_depth"), [(0.5, 3), (0.08, 2)])
def test_principled_surfaces_are_cached_and_agree_with_the_path(variant, roughness, max_depth):
    scene, depth = corner(Material("principled", roughness=roughness)), {"max_depth": max_depth}
    cached = pair(scene, variant, samples=16, cache_cell=2, cache_rays=128, **depth).right
    assert cached.mean() == pytest.approx(traced_mean(roughness, max_depth), rel=0.01)


@pytest.mark.parametrize("variant", VARIANTS)
def test_same_seed_same_bits_and_another_seed_other_light(variant):
    first, again, other = (pair(corner(), variant, samples=2, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first.left, again.left) and np.array_equal(first.right, again.right)
    assert not np.array_equal(first.left, other.left)


@needs_llvm
def test_nothing_is_collected_while_pictures_are_taken(monkeypatch):
    busy, when = [], []

    class Ring:
        def __init__(self):
            self.ring = self

        def __del__(self):
            when.append(bool(busy))

    take = JitPhotographer.photograph

    def taking(*arguments):
        busy.append(Ring() and None)
        images = take(*arguments)
        busy.clear()
        return images

    monkeypatch.setattr(JitPhotographer, "photograph", taking)
    often = gc.get_threshold()
    gc.set_threshold(1, 1, 1)
    try:
        pair(corner(), "llvm_ad_mono", samples=1)
    finally:
        gc.set_threshold(*often)
    gc.collect()
    assert when == [False]
    assert gc.isenabled()


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_region_is_cut_out_of_the_frame(variant):
    part = Region(37, 26, 60, 44)
    scene = corner()
    whole = pair(scene, variant, [RIG.full_frame], samples=2)
    some = pair(scene, variant, [part], samples=2)
    inner = np.s_[12:-12, 12:-12]  # at the rim cells outside the region are missing
    cut = whole.left[part.slices][inner]
    assert np.abs(some.left[inner] - cut).max() < 1e-4


@pytest.mark.parametrize("variant", VARIANTS)
def test_mirrors_are_path_traced_with_many_rays_whatever_the_setting(variant):
    scene, part = corner(MATERIALS["mirror"]), [Region(50, 30, 4, 4)]
    cached = pair(scene, variant, part, samples=1)
    traced = pair(scene, variant, part, samples=256, indirect="path")
    assert np.array_equal(cached.left, traced.left)


@pytest.mark.parametrize(
    ("settings", "samples"),
    [({}, 4), ({"indirect": "path"}, 256), ({"indirect": "path", "samples": 8}, 8)],
)
def test_the_usual_number_of_rays_is_that_which_the_light_needs(settings, samples):
    assert MitsubaRenderer(variant="scalar_rgb", **settings).description["samples"] == samples


@needs_llvm
def test_turns_are_those_of_mitsuba():
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    names = np.array([0, 1, 65537, 2**31], dtype=np.uint32)
    theirs = mi.sample_tea_32(mi.UInt32(names), mi.UInt32(77), rounds=4)
    theirs = np.stack([np.array(word) for word in theirs]) >> 8
    assert np.array_equal(_turns(names, 77), theirs.astype(np.float32) * np.float32(2**-24))
