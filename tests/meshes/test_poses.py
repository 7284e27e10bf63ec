"""Stable poses: probabilities, symmetries, and the ground that a part lies on."""

import numpy as np
import pytest
import trimesh

from qs3.errors import InputError
from qs3.meshes.poses import _centre_of_mass, draw_pose, resting_poses
from qs3.parts.resting import centre_of_mass


def bracket(mirrored: bool = False) -> trimesh.Trimesh:
    """An angle with arms of unequal length: its mirror image is no turned copy of it."""
    long = trimesh.creation.box((4, 1, 0.4))
    short = trimesh.creation.box((1, 2, 0.4))
    short.apply_translation((-1.5, 1.5, 0))
    part = trimesh.util.concatenate([long, short])
    if mirrored:
        part.apply_scale((1, -1, 1))
    return part


@pytest.mark.parametrize(
    ("mesh", "count"),
    [
        (trimesh.creation.box((3, 2, 1)), 3),
        (trimesh.creation.box((1, 1, 1)), 1),
        (trimesh.creation.cylinder(1, 3), 2),
        (trimesh.creation.icosphere(2), 1),
    ],
)
def test_poses_equal_by_symmetry_count_once(mesh, count):
    poses = resting_poses(mesh)
    assert len(poses) == count
    shares = [pose.probability for pose in poses]
    assert sum(shares) == pytest.approx(1)
    assert shares == sorted(shares, reverse=True)


def test_a_box_rests_on_its_sides_as_often_as_they_fill_the_sky():
    """Probability of a face: the solid angle under which the centre of mass sees it."""
    sides = np.array([3.0, 2.0, 1.0])
    poses = resting_poses(trimesh.creation.box(sides))

    def solid_angle(a, b, height):  # of a rectangle, seen from above its centre
        a, b = a / 2, b / 2
        return 4 * np.arcsin(a * b / np.sqrt((a**2 + height**2) * (b**2 + height**2)))

    wanted = {s: 2 * solid_angle(*np.delete(sides, i), s / 2) for i, s in enumerate(sides)}
    for pose in poses:
        height = float(np.ptp(trimesh.creation.box(sides).vertices @ pose.rotation[2]))
        # On the side that is `height` away from the opposite one.
        assert pose.probability == pytest.approx(wanted[round(height, 3)] / (4 * np.pi), abs=1e-6)


def test_a_part_on_its_other_side_is_another_pose():
    flat = [
        pose
        for pose in resting_poses(bracket())
        if np.ptp(bracket().vertices @ pose.rotation[2]) == pytest.approx(0.4)
    ]
    assert len(flat) == 2


@pytest.mark.parametrize("pose", ["resting", "any"])
def test_convention_rotations_are_proper(pose):
    rng = np.random.default_rng(0)
    for _ in range(10):
        rotation, _ = draw_pose(bracket(), pose, rng)
        assert np.allclose(rotation @ rotation.T, np.eye(3))
        assert np.linalg.det(rotation) == pytest.approx(1)


def test_a_drawn_part_lies_flat_and_its_centre_of_mass_is_above_its_foot():
    part, rng = bracket(), np.random.default_rng(1)
    for _ in range(20):
        rotation, drawn = draw_pose(part, "resting", rng)
        posed = part.vertices @ rotation.T
        foot = posed[posed[:, 2] < posed[:, 2].min() + 1e-6]
        assert len(np.unique(foot.round(6), axis=0)) >= 3
        centre = (rotation @ part.center_mass)[:2]
        corners = foot[:, :2] - centre
        angles = np.sort(np.arctan2(corners[:, 1], corners[:, 0]))
        gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
        assert gaps.max() <= np.pi + 1e-6  # the foot surrounds it
        assert 0 < drawn["pose_probability"] <= 1


def test_draws_follow_the_probabilities_and_the_seed():
    part = trimesh.creation.cylinder(1, 3)
    rng = np.random.default_rng(2)
    drawn = [draw_pose(part, "resting", rng)[1]["pose"] for _ in range(300)]
    lying = resting_poses(part)[0].probability
    assert np.mean(np.array(drawn) == 0) == pytest.approx(lying, abs=0.07)
    again = np.random.default_rng(2)
    assert drawn == [draw_pose(part, "resting", again)[1]["pose"] for _ in range(300)]
    assert draw_pose(part, "upright", rng)[1] == {}


def ring(thickness: float) -> trimesh.Trimesh:
    return trimesh.creation.annulus(1, 2, thickness)


def flat_ring() -> trimesh.Trimesh:
    """A gasket of one face, as a STEP of one face has it."""
    whole = ring(0.2)
    top = np.isclose(whole.triangles_center[:, 2], 0.1)
    return trimesh.Trimesh(whole.vertices, whole.faces[top], process=False)


@pytest.mark.parametrize("tilt", [0.0, 0.4])
@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
        flat_ring(),
        ring(1e-9),
        trimesh.creation.box((1, 1, 1e-9)),
        trimesh.creation.box((1, 1e-3, 1e-9)),
    ],
)
@pytest.mark.timeout(20)
def test_a_flat_mesh_is_refused_by_the_name_of_its_file(mesh, tilt):
    lying = mesh.copy()
    lying.apply_transform(trimesh.transformations.euler_matrix(tilt, tilt, tilt))
    lying.metadata["file_name"] = "gasket.step"
    with pytest.raises(InputError, match=r"gasket\.step: is flat"):
        resting_poses(lying)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("thickness", [1e-3, 1e-4, 2e-5])
def test_a_thin_plate_lies_on_either_face(thickness):
    poses = resting_poses(trimesh.creation.box((1, 0.7, thickness)))
    assert poses[0].probability > 0.99
    assert abs(poses[0].rotation[2, 2]) == pytest.approx(1)


@pytest.mark.timeout(30)
def test_a_ball_of_many_faces_has_one_pose_within_seconds():
    (pose,) = resting_poses(trimesh.creation.icosphere(5, 0.05))
    assert pose.probability == pytest.approx(1)


def cone() -> trimesh.Trimesh:
    """Its centre of mass is a quarter up; that of its surface, with its foot, is higher."""
    return trimesh.creation.cone(1, 2, sections=24)


def soup(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """As STL has it: each triangle with corners of its own."""
    return trimesh.Trimesh(
        mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False
    )


def without_a_sliver(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """With a vertex on an edge of one of its two faces alone, as a face without area leaves it."""
    a, b, c = mesh.faces[0]
    middle = len(mesh.vertices)
    vertices = np.vstack([mesh.vertices, mesh.vertices[[a, b]].mean(axis=0)])
    faces = np.vstack([mesh.faces[1:], [[a, middle, c], [middle, b, c]]])
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize(
    "stored",
    [
        soup,
        without_a_sliver,
        lambda mesh: soup(without_a_sliver(mesh)),
        lambda mesh: trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False),
    ],
    ids=["apart", "no sliver", "apart, no sliver", "inside out"],
)
@pytest.mark.parametrize("mesh", [cone(), bracket()], ids=["cone", "touching solids"])
def test_poses_are_those_of_the_centre_of_mass_however_the_mesh_is_stored(mesh, stored):
    wanted = [pose.probability for pose in resting_poses(mesh)]
    found = [pose.probability for pose in resting_poses(stored(mesh))]
    assert found == pytest.approx(wanted, abs=1e-6)


def test_a_cone_rests_under_its_centre_of_mass():
    """Shares of the foot by the solid angle of a disc, seen from a quarter of the height."""
    poses = {round(abs(pose.rotation[2, 2]), 3): pose.probability for pose in resting_poses(cone())}
    foot = (1 - 0.5 / np.hypot(1, 0.5)) / 2
    assert poses[1.0] == pytest.approx(foot, abs=0.01)


def test_poses_are_worked_out_once_for_all_scans_of_a_mesh(monkeypatch):
    mesh = trimesh.creation.cone(0.3, 0.5)
    first = resting_poses(mesh)
    monkeypatch.setattr("qs3.meshes.poses._stable", None)
    for scale in (1, 7.3, 1e-3):
        mesh.vertices = mesh.vertices * scale + 0.1
        assert resting_poses(mesh) is first


def hollow() -> trimesh.Trimesh:
    """A plate with a closed void in one half: its other half is heavier."""
    void = trimesh.creation.box(bounds=[[0.2, -0.8, -0.2], [1.8, 0.8, 0.2]])
    void.invert()
    return trimesh.util.concatenate([trimesh.creation.box((4, 2, 0.6)), void])


def part_baked_mirrored(lies: str) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """A plate and a block as they are, and with the block inside out."""
    plate = trimesh.creation.box(bounds=[[0, 0, 0], [100, 100, 5]])
    low = {"apart": [80, 80, 6], "touching": [80, 80, 5], "at an edge": [80, 100, 0]}[lies]
    block = trimesh.creation.box(bounds=[low, np.add(low, (20, 20, 55))])
    right = trimesh.util.concatenate([plate, block])
    block.invert()
    return right, trimesh.util.concatenate([plate, block])


@pytest.mark.parametrize("turn", [1, -1], ids=["", "all turned"])
@pytest.mark.parametrize("lies", ["apart", "touching", "at an edge"])
def test_a_body_that_is_inside_out_has_its_weight(lies, turn):
    """As STL of a mirrored placement has it; before, it lifted the part."""
    right, wrong = part_baked_mirrored(lies)
    wrong = trimesh.Trimesh(wrong.vertices, wrong.faces[:, ::turn], process=False)
    for centre in (_centre_of_mass(soup(wrong)), centre_of_mass(wrong.triangles)):
        np.testing.assert_allclose(centre, right.center_mass, atol=1e-9)


@pytest.mark.parametrize("inverted", [(0,), (1,), (0, 1)], ids=["shaft", "ring", "both"])
def test_a_ring_around_a_shaft_is_no_hollow_of_it(inverted):
    shaft = trimesh.creation.cylinder(1, 10, sections=32)
    ring = trimesh.creation.annulus(1.05, 2, 1, sections=32).apply_translation((0, 0, 3.5))
    right = trimesh.util.concatenate([shaft, ring]).center_mass
    for number in inverted:
        (shaft, ring)[number].invert()
    mesh = trimesh.util.concatenate([shaft, ring])
    for centre in (_centre_of_mass(mesh), centre_of_mass(mesh.triangles)):
        np.testing.assert_allclose(centre, right, atol=1e-9)


@pytest.mark.parametrize("turned", [(), (0,), (1,), (0, 1)], ids=str)
def test_a_hollow_of_a_body_that_is_inside_out_has_no_weight(turned):
    sides = ((3, 0), (1.5, 5), (1.3, 5))
    bodies = [trimesh.creation.box((s, s, s)).apply_translation((x, 0, 0)) for s, x in sides]
    bodies[2].invert()
    right = trimesh.util.concatenate(bodies).center_mass
    for number in turned:
        for body in (bodies[:1], bodies[1:])[number]:
            body.invert()
    mesh = trimesh.util.concatenate(bodies)
    for centre in (_centre_of_mass(mesh), centre_of_mass(mesh.triangles)):
        np.testing.assert_allclose(centre, right, atol=1e-9)


@pytest.mark.parametrize("turn", [1, -1], ids=["", "all turned"])
def test_a_hollow_has_no_weight(turn):
    mesh = hollow()
    turned = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::turn], process=False)
    for centre in (_centre_of_mass(turned), centre_of_mass(turned.triangles)):
        np.testing.assert_allclose(centre, mesh.center_mass, atol=1e-12)
        assert centre[0] < -0.1
