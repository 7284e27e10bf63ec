"""Stable poses: probabilities, symmetries, and the ground that a part lies on."""

import numpy as np
import pytest
import trimesh

from qs3.errors import InputError
from qs3.meshes.poses import draw_pose, resting_poses


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


def test_a_flat_mesh_has_no_resting_pose():
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    with pytest.raises(InputError, match="no convex hull"):
        resting_poses(sheet)
