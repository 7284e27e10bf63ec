"""Cycles itself, held against Mitsuba and against what is known of the light."""

import os
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
import pytest
import trimesh

from qs3.sensor.light import Body, LightSettings, Scene
from qs3.sensor.light.cycles import CyclesRenderer, interpreter
from qs3.sensor.light.materials import Material, get_material
from qs3.sensor.light.mitsuba import MitsubaRenderer, usable
from qs3.sensor.rig import Pose, Region, StereoRig

from .test_render import asymmetric

pytestmark = pytest.mark.skipif(interpreter() is None, reason="no Cycles here: make cycles")

RIG = StereoRig(width=96, height=64, focal=110.0, baseline=0.3)
POSE = Pose.looking_at(np.array([1.0, -2.0, 1.5]), np.array([0.1, 0.0, -0.1]))
LEVEL = Pose.looking_at(np.array([0.0, -3.0, 0.0]), np.zeros(3))
WHITE = np.ones((8, 8), np.float32)
DARK = LightSettings(projector=0.0, sky=0.0, ambient=0.0, sky_elevation=60.0)


def mitsuba(samples: int = 64, indirect: Literal["path", "cached"] = "path") -> MitsubaRenderer:
    variant = "llvm_ad_mono" if usable("llvm_ad_mono") else "scalar_rgb"
    return MitsubaRenderer(variant=variant, samples=samples, indirect=indirect)


def box(extents, centre) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=extents).apply_translation(centre)


def wall(material: Material | None = None, light: LightSettings = DARK) -> Scene:
    """A wall square to the rig that fills the frame."""
    body = Body(box([9, 0.02, 9], [0, 0.01, 0]), material or Material())
    return Scene((body,), light, WHITE, 0.625, 0.625)


def shot(renderer, scene: Scene, region: Region = RIG.full_frame, pose: Pose = LEVEL):
    """The left image of a region."""
    return renderer.render(scene, RIG, [pose], [0], [region])[0].left


def chart_scene(light: LightSettings | None = None) -> Scene:
    """An asymmetric thing on a floor in the light of an asymmetric picture."""
    rng = np.random.default_rng(3)
    cells = (rng.random((24, 30)) > 0.6).astype(np.uint8) * 255
    picture = cv2.resize(cells, (240, 192), interpolation=cv2.INTER_NEAREST)
    cv2.putText(picture, "F7", (30, 120), cv2.FONT_HERSHEY_SIMPLEX, 3, 255, 8)
    floor = Body(box([6, 6, 0.02], [0, 0, -0.26]))
    pattern = picture.astype(np.float32) / 255
    light = light or LightSettings(sky_elevation=30.0)
    return Scene((Body(asymmetric()), floor), light, pattern, 0.4, 0.32)


def displacement(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Shift of b against a in pixels by least squares on the gradient (Lucas and Kanade)."""
    a, b = (cv2.GaussianBlur(image.astype(np.float64), (0, 0), 1.0) for image in (a, b))
    rows, columns = np.gradient((a + b) / 2)
    inner = (slice(8, -8), slice(8, -8))
    slopes = np.stack([columns[inner].ravel(), rows[inner].ravel()], axis=1)
    return np.linalg.lstsq(slopes, (a - b)[inner].ravel(), rcond=None)[0]


@pytest.mark.parametrize(
    ("light", "samples"),
    [
        (replace(DARK, projector=45.6), 16),
        (replace(DARK, ambient=0.3), 16),
        (replace(DARK, sky=1.0, sky_elevation=9.3), 64),
    ],
    ids=["projector", "ambient", "sky"],
)
def test_each_light_is_as_bright_as_mitsubas(light, samples):
    renderers = mitsuba(samples), CyclesRenderer(samples=samples)
    images = [shot(renderer, wall(light=light)) for renderer in renderers]
    thirds = [cv2.resize(i, (3, 3), interpolation=cv2.INTER_AREA) for i in images]
    np.testing.assert_allclose(thirds[1], thirds[0], rtol=0.02)


def test_the_projector_keeps_the_law_of_a_point_light():
    # A wall of albedo ρ at distance z has radiance ρ/π · I·cos³θ/z²; the setting is I/π.
    image = shot(CyclesRenderer(samples=4), wall(light=replace(DARK, projector=45.6)))
    u, v = np.meshgrid((np.arange(96) - 47.5) / 110, (np.arange(64) - 31.5) / 110)
    u = u - 0.5 * RIG.baseline / 3  # from the projector, half a baseline to the right
    expected = 0.8 * 45.6 / 9 / (1 + u**2 + v**2) ** 1.5
    np.testing.assert_allclose(image, expected, rtol=5e-3)


def test_convention_the_chart_lies_where_mitsuba_has_it():
    rig = StereoRig(width=192, height=128, focal=240.0, baseline=0.3)
    pairs = [
        renderer.render(chart_scene(), rig, [POSE], [0])[0]
        for renderer in (mitsuba(32), CyclesRenderer(samples=32))
    ]
    for ours, theirs in ((pairs[0].left, pairs[1].left), (pairs[0].right, pairs[1].right)):
        assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.98
        assert np.corrcoef(ours[:, ::-1].ravel(), theirs.ravel())[0, 1] < 0.5
        assert np.corrcoef(ours[::-1].ravel(), theirs.ravel())[0, 1] < 0.5
        assert np.abs(displacement(ours, theirs)).max() < 0.05
        assert theirs.mean() == pytest.approx(ours.mean(), rel=0.02)
    assert np.abs(displacement(pairs[1].left, np.roll(pairs[1].left, 1, axis=1))[0] - 1) < 0.2


def test_faces_that_share_a_plane_do_not_shade_each_other():
    # Two plates whose upper faces are one plane where they overlap.
    plates = [box([2, 1, 0.2], [0.3, 0, -0.1]), box([1, 2, 0.2], [0, 0.1, -0.1])]
    both, one = trimesh.util.concatenate(plates), plates[0]
    above = Pose.looking_at(np.array([0.0, -1.0, 3.0]), np.zeros(3))
    light = LightSettings(ambient=0.3, sky=0.0)
    scenes = [Scene((Body(mesh),), light, WHITE, 0.6, 0.6) for mesh in (one, both)]
    region, renderer = Region(40, 26, 16, 12), CyclesRenderer(samples=64)
    alone, shared = (shot(renderer, scene, region, above) for scene in scenes)
    np.testing.assert_allclose(shared, alone, rtol=0.05)


def test_equal_seeds_give_equal_bits_and_others_do_not():
    renderer = CyclesRenderer(samples=4)
    scene = chart_scene()
    first, again, other = (renderer.render(scene, RIG, [POSE], [s])[0] for s in (5, 5, 6))
    np.testing.assert_array_equal(first.left, again.left)
    np.testing.assert_array_equal(first.right, again.right)
    assert (first.left != other.left).mean() > 0.5
    # Among other views and on one processor.
    before = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    try:
        if before:
            os.sched_setaffinity(0, {min(before)})
        fresh = renderer.render(scene, RIG, [LEVEL, POSE], [0, 5])[1]
    finally:
        if before:
            os.sched_setaffinity(0, before)
    np.testing.assert_array_equal(first.left, fresh.left)
    np.testing.assert_array_equal(first.right, fresh.right)


def test_a_region_has_the_bits_of_the_whole_frame():
    renderer = CyclesRenderer(samples=4)
    region = Region(17, 9, 50, 33)
    whole = renderer.render(chart_scene(), RIG, [POSE], [1])[0]
    part = renderer.render(chart_scene(), RIG, [POSE], [1], [region])[0]
    for a, b in ((part.left, whole.left), (part.right, whole.right)):
        assert a.shape == (33, 50)
        np.testing.assert_array_equal(a, b[region.slices])


@pytest.mark.parametrize(
    ("name", "tolerance"),
    # Blender's principled model is not Mitsuba's: its coat takes more of the diffuse light.
    [("diffuse", 0.02), ("mirror", 0.02), ("glass", 0.02), ("metal", 0.03), ("principled", 0.07)],
)
def test_a_ball_of_each_material_is_as_bright_as_mitsubas(name, tolerance):
    ball = Body(trimesh.creation.icosphere(3, 0.45), get_material(name))
    floor = Body(box([6, 6, 0.02], [0, 0, -0.46]))
    scene = Scene((ball, floor), LightSettings(), WHITE, 0.4, 0.4)
    rig = StereoRig(width=64, height=64, focal=170.0)
    pose = Pose.looking_at(np.array([1.0, -2.0, 1.8]), np.zeros(3))
    theirs, ours = (
        renderer.render(scene, rig, [pose], [0])[0].left.mean()
        for renderer in (mitsuba(64), CyclesRenderer(samples=64))
    )
    assert ours == pytest.approx(theirs, rel=tolerance)


def test_bounces_end_where_mitsubas_do():
    # A white corner: light that bounces brightens it; equal depths give equal light.
    corner = [box([4, 0.1, 4], [0, 1.05, 0]), box([0.1, 2, 4], [0.8, 0, 0])]
    scene = Scene(
        (Body(trimesh.util.concatenate(corner)),), replace(DARK, projector=45.6), WHITE, 0.6, 0.6
    )
    levels = []
    for bounces in (0, 1, 2):
        theirs = replace(mitsuba(64), max_depth=2 + bounces)
        ours = CyclesRenderer(samples=32, max_bounces=bounces)
        both = [shot(r, scene, Region(32, 16, 32, 32)).mean() for r in (theirs, ours)]
        assert both[1] == pytest.approx(both[0], rel=0.01)
        levels.append(both[1])
    assert levels[1] > 1.03 * levels[0]
    assert levels[2] > 1.003 * levels[1]
