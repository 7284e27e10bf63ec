import numpy as np
import pytest
import trimesh

from qs3.errors import InputError
from qs3.sensor.light import Body, LightSettings, Scene
from qs3.sensor.light.materials import Material
from qs3.sensor.light.mitsuba import MitsubaRenderer, usable
from qs3.sensor.light.pattern import PatternSettings, pattern_image
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.rig import Pose, Region, StereoRig


def scene_of(mesh, pattern=None, light=None) -> Scene:
    pattern = pattern_image(PatternSettings()) if pattern is None else pattern
    return Scene((Body(mesh),), light or LightSettings(), pattern, 0.625, 0.625)


# For cameras that look level: the sky begins above what they see.
HIGH_SKY = LightSettings(sky_elevation=30.0)


def asymmetric() -> trimesh.Trimesh:
    """An L with a tower: no mirror image of it is itself."""
    parts = [([0, 0, -0.2], [1, 0.4, 0.1]), ([0.4, 0.25, -0.2], [0.2, 0.3, 0.1])]
    parts += [([-0.4, 0.0, 0.05], [0.2, 0.2, 0.5])]
    boxes = [trimesh.creation.box(extents=e).apply_translation(c) for c, e in parts]
    return trimesh.util.concatenate(boxes)


POSE = Pose.looking_at(np.array([2.0, -3.0, 2.0]), np.array([0.1, 0.0, -0.1]))


def test_convention_true_depth_is_along_the_axis_through_pixel_centres(small_rig):
    plate = trimesh.creation.box(extents=[4, 4, 0.02])
    plate.apply_translation([0, 0, 3.01])  # its near face is at z = 3 of a camera at the origin
    depth = DepthCaster(plate).cast(small_rig, Pose(np.eye(4)), small_rig.full_frame).depth
    np.testing.assert_allclose(depth, 3.0, atol=1e-9)


def test_true_depth_of_a_tilted_plane_is_the_formula(small_rig):
    slope = 0.4  # z = 3 + slope·x
    corners = np.array([[x, y, 3 + slope * x] for x in (-3.0, 3) for y in (-3.0, 3)])
    plane = trimesh.Trimesh(corners, [[0, 1, 2], [1, 3, 2]], process=False)
    depth = DepthCaster(plane).cast(small_rig, Pose(np.eye(4)), small_rig.full_frame).depth
    u = (np.arange(540) - 269.5) / 750
    np.testing.assert_allclose(depth, np.broadcast_to(3 / (1 - slope * u), (540, 540)), rtol=1e-6)


@pytest.fixture(scope="module")
def shown(small_rig, renderer):
    """The asymmetric thing, photographed."""
    return renderer.render(scene_of(asymmetric()), small_rig, [POSE], [1])[0]


def test_convention_images_lie_on_the_true_silhouette_and_are_not_mirrored(shown, small_rig):
    frame = small_rig.full_frame
    for image, camera in zip(shown.canvas(frame), (POSE, small_rig.right(POSE)), strict=True):
        seen = np.abs(image - shown.background) > 1e-4
        true = np.isfinite(DepthCaster(asymmetric()).cast(small_rig, camera, frame).depth)
        overlap = (seen & true).sum() / (seen | true).sum()
        assert overlap > 0.97
        assert (seen[:, ::-1] & true).sum() / (seen[:, ::-1] | true).sum() < 0.9


def test_convention_projected_picture_is_upright(small_rig, renderer):
    # A picture that is bright in its top left quarter alone, thrown on a plate square to the rig.
    picture = np.zeros((64, 64), np.float32)
    picture[:32, :32] = 1.0
    plate = trimesh.creation.box(extents=[1.6, 1.6, 0.02])
    turn = np.eye(4)
    turn[:3, :3] = Pose.looking_at(np.array([0.0, -3.0, 0.0]), np.zeros(3)).camera_to_world[:3, :3]
    plate.apply_transform(turn)
    pose = Pose.looking_at(np.array([0.0, -3.0, 0.0]), np.zeros(3))
    pair = renderer.render(scene_of(plate, picture, HIGH_SKY), small_rig, [pose], [0])[0]
    image = pair.canvas(small_rig.full_frame)[0]
    quarter = image[150:390, 150:390]
    top_left, rest = quarter[:110, :110].mean(), quarter[130:, 130:].mean()
    assert top_left > 3 * rest
    assert top_left > 3 * quarter[:110, 150:].mean()
    assert top_left > 3 * quarter[150:, :110].mean()


def test_projector_casts_hard_shadows(small_rig, renderer):
    # A small plate stands before a wall: the wall's lit share falls where the plate shades it.
    wall = trimesh.creation.box(extents=[3, 0.02, 3]).apply_translation([0, 0.5, 0])
    plate = trimesh.creation.box(extents=[0.3, 0.02, 0.3]).apply_translation([0, -0.5, 0])
    pose = Pose.looking_at(np.array([0.0, -3.0, 0.0]), np.zeros(3))
    rig = StereoRig(width=540, height=540, focal=750.0, baseline=0.6)
    bright = np.ones((16, 16), np.float32)
    scene = scene_of(trimesh.util.concatenate([wall, plate]), bright, HIGH_SKY)
    image = renderer.render(scene, rig, [pose], [0])[0].canvas(rig.full_frame)[0]
    # The left camera stands at 0, the projector at +0.3: seen from the camera the shadow falls on
    # the wall from tan −0.094 to the plate's left edge at tan −0.06, and not at its right.
    row = image[260:280].mean(axis=0)
    centre = round(rig.principal_point[0])
    shaded, lit = row[centre - 68 : centre - 48], row[centre + 48 : centre + 68]
    assert shaded.max() < 0.7 * lit.min()


def test_a_view_into_the_sky_is_refused(small_rig, renderer):
    # What is not rendered is filled with the ground's light; the sky would be missing.
    low = Pose.looking_at(np.array([0.0, -3.0, 0.2]), np.zeros(3))
    with pytest.raises(InputError, match="sky"):
        renderer.render(scene_of(asymmetric()), small_rig, [low], [0])


def test_a_variant_is_set_again_after_another(fresh_renderer):
    import mitsuba

    mitsuba.set_variant("scalar_spectral")
    assert fresh_renderer.description["variant"] == "scalar_rgb"
    assert mitsuba.variant() == "scalar_rgb"


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_mono"])
def test_light_passes_mitsubas_glass_there_and_back(variant):
    if not usable(variant):
        pytest.skip(f"{variant} does not work here: no suitable libLLVM (19 is known to work)")
    rig = StereoRig(width=160, height=120, focal=220.0, baseline=0.1)
    level = Pose.looking_at(np.array([0.0, -3.0, 0.0]), np.zeros(3))
    white = np.ones((8, 8), np.float32)
    light = LightSettings(sky=0.0, ambient=0.0, sky_elevation=60.0)
    bodies = (
        Body(trimesh.creation.box(extents=[2, 0.01, 2]), Material("glass")),
        Body(trimesh.creation.box(extents=[9, 1, 9]).apply_translation([0, 2, 0])),
    )
    renderer = MitsubaRenderer(variant=variant, samples=64, indirect="path")
    dimmed, plain = (
        renderer.render(scene, rig, [level], [0], [Region(70, 50, 20, 20)])[0].left.mean()
        for scene in (Scene(b, light, white, 0.6, 0.6) for b in (bodies, bodies[1:]))
    )
    # Two panes, each passed twice; a pane of index 1.5 reflects R = 2F/(1 + F), F = 0.04.
    assert dimmed / plain == pytest.approx((1 - 0.08 / 1.04) ** 4, abs=0.02)
