"""Cycles and Mitsuba as they are by default before the same scenes; glass; a whole scan."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.errors import InputError
from qs3.sensor.materials import Material
from qs3.sensor.render import Body, LightSettings, Scene
from qs3.sensor.render._worker_process import close_workers
from qs3.sensor.render.cycles import CyclesRenderer, interpreter
from qs3.sensor.render.mitsuba import MitsubaRenderer, usable
from qs3.sensor.rig import Pose, Region, StereoRig
from qs3.sensor.scan import scan

WITH_CYCLES = pytest.mark.skipif(
    interpreter() is None, reason="no Cycles here: make cycles, or set QS3_BLENDER"
)
RIG = StereoRig(width=160, height=120, focal=220.0, baseline=0.1)
POSE = Pose.looking_at(np.array([1.2, -1.9, 1.3]), np.array([0.05, 0.0, -0.1]))
LEVEL = Pose.looking_at(np.array([0.0, -3.0, 0.0]), np.zeros(3))
WHITE = np.ones((8, 8), np.float32)


@pytest.fixture(scope="module", autouse=True)
def tidy():
    yield
    close_workers()


def mitsuba(**settings) -> MitsubaRenderer:
    variant = "llvm_ad_mono" if usable("llvm_ad_mono") else "scalar_rgb"
    return MitsubaRenderer(variant=variant, **settings)


def box(extents, centre) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=extents).apply_translation(centre)


def asymmetric() -> trimesh.Trimesh:
    parts = [([1, 0.4, 0.1], [0, 0, -0.2]), ([0.2, 0.3, 0.1], [0.4, 0.25, -0.2])]
    parts += [([0.2, 0.2, 0.5], [-0.4, 0.0, 0.05])]
    return trimesh.util.concatenate([box(*part) for part in parts])


def letters() -> np.ndarray:
    picture = np.zeros((480, 480), np.uint8)
    for row, text in enumerate(("QS3", "FGR", "LJ7")):
        cv2.putText(picture, text, (20, 150 + 150 * row), cv2.FONT_HERSHEY_SIMPLEX, 5, 255, 30)
    return 0.1 + 0.9 * cv2.GaussianBlur(picture.astype(np.float32) / 255, (0, 0), 2)


def alone(material: Material, light: LightSettings, pattern: np.ndarray) -> Scene:
    return Scene((Body(asymmetric(), material),), light, pattern, 0.3, 0.3)


@WITH_CYCLES
def test_convention_the_default_renderers_images_register():
    scene = alone(Material(), LightSettings(), letters())
    cycles, ours = (
        renderer.render(scene, RIG, [POSE], [1])[0].canvas(RIG.full_frame)
        for renderer in (CyclesRenderer(samples=128), mitsuba(samples=16))
    )
    for a, b in zip(cycles, ours, strict=True):
        assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.98
        assert np.corrcoef(a[:, ::-1].ravel(), b.ravel())[0, 1] < 0.5
        shift, _ = cv2.phaseCorrelate(a.astype(np.float64), b.astype(np.float64))
        assert max(map(abs, shift)) < 0.05


@WITH_CYCLES
@pytest.mark.parametrize("dark", [("sky", "ambient"), ("projector", "ambient"), ("sky",), ()])
def test_levels_agree_light_by_light_on_wall_and_object(dark):
    light = replace(LightSettings(), **dict.fromkeys(dark, 0.0))
    facing = Scene(
        (Body(box([3, 0.02, 3], [0, 0.01, 0])),),
        replace(light, sky_elevation=30.0),
        WHITE,
        0.3,
        0.3,
    )
    part = [Region(50, 40, 60, 40)]
    for scene, pose, regions in (
        (facing, LEVEL, part),
        (alone(Material(), light, WHITE), POSE, None),
    ):
        cycles, ours = (
            renderer.render(scene, RIG, [pose], [1], regions)[0]
            for renderer in (CyclesRenderer(samples=64), mitsuba(samples=16))
        )
        assert cycles.left.mean() == pytest.approx(ours.left.mean(), rel=0.02)
        assert cycles.right.mean() == pytest.approx(ours.right.mean(), rel=0.02)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_mono"])
def test_light_passes_mitsubas_glass_there_and_back(variant):
    if not usable(variant):
        pytest.skip(f"{variant} does not work here: no suitable libLLVM (19 is known to work)")
    light = LightSettings(sky=0.0, ambient=0.0, sky_elevation=60.0)
    bodies = (
        Body(box([2, 0.01, 2], [0, 0, 0]), Material("glass")),
        Body(box([9, 1, 9], [0, 2, 0])),
    )
    renderer = MitsubaRenderer(variant=variant, samples=64, indirect="path")
    dimmed, plain = (
        renderer.render(scene, RIG, [LEVEL], [0], [Region(70, 50, 20, 20)])[0].left.mean()
        for scene in (Scene(b, light, WHITE, 0.6, 0.6) for b in (bodies, bodies[1:]))
    )
    # Two panes, each passed twice; a pane of index 1.5 reflects R = 2F/(1 + F), F = 0.04.
    assert dimmed / plain == pytest.approx((1 - 0.08 / 1.04) ** 4, abs=0.02)


@WITH_CYCLES
def test_a_scan_takes_what_a_view_transform_shows():
    renderer = CyclesRenderer(samples=4, view_transform="Filmic")
    made = scan(shapes.make("chair", seed=1), seed=1, renderer=renderer, views=1, num_points=256)
    assert made.points.shape == (256, 3)
    _, distance, _ = trimesh.proximity.closest_point(made.mesh, made.points)
    assert np.median(distance) < 0.02
    assert made.views[0].valid_fraction > 0.5


@WITH_CYCLES
def test_cycles_refuses_a_view_into_the_sky():
    low = Pose.looking_at(np.array([0.0, -3.0, 0.2]), np.zeros(3))
    with pytest.raises(InputError, match="sky"):
        CyclesRenderer(samples=1).render(alone(Material(), LightSettings(), WHITE), RIG, [low], [0])
