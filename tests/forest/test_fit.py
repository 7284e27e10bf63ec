"""CAD laid onto scans: the pose comes back, and the right part fits best."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from qs3.errors import InputError
from qs3.forest.fit import PartModel, fit_part
from qs3.forest.parts import Cad, worse


def angle(size: float = 0.08) -> trimesh.Trimesh:
    """A part without any symmetry, in metres."""
    parts = [
        trimesh.creation.box(extents).apply_translation(centre)
        for extents, centre in [
            ((1, 0.5, 0.2), (0.5, 0.25, 0.1)),
            ((0.3, 0.5, 0.5), (0.15, 0.25, 0.45)),
            ((0.2, 0.2, 0.2), (0.9, 0.1, 0.3)),
        ]
    ]
    return trimesh.util.concatenate(parts).apply_scale(size)


def view(mesh: trimesh.Trimesh, direction, rng, noise: float = 0.0005) -> np.ndarray:
    """What a camera far away in a direction sees, by rays."""
    direction = np.asarray(direction) / np.linalg.norm(direction)
    _, _, axes = np.linalg.svd(direction[None])
    across = np.stack(np.meshgrid(*[np.linspace(-0.1, 0.1, 70)] * 2), axis=-1).reshape(-1, 2)
    origins = mesh.bounds.mean(axis=0) + across @ axes[1:] + direction
    hits, *_ = mesh.ray.intersects_location(
        origins, np.broadcast_to(-direction, origins.shape), multiple_hits=False
    )
    return hits + rng.normal(size=hits.shape) * noise


@pytest.mark.parametrize("seed", range(4))
def test_the_pose_of_a_part_comes_back_from_one_view(seed):
    rng = np.random.default_rng(seed)
    part = angle()
    cloud = view(part, rng.normal(size=3), rng)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    scan = cloud @ pose[:3, :3].T + pose[:3, 3]
    fit = fit_part(scan, PartModel.of_mesh(part, 1.0))
    corners = part.vertices
    off = trimesh.transform_points(corners, fit.pose) - trimesh.transform_points(corners, pose)
    assert np.linalg.norm(off, axis=1).max() < 0.004
    assert fit.residual < 0.005
    assert fit.coverage > 0.8


def test_convention_a_fit_is_a_rotation_and_no_mirror(rng):
    part = angle()
    mirrored = part.copy().apply_scale((1, -1, 1))
    cloud = view(part, (2, -2.6, 0.4), rng)
    good = fit_part(cloud, PartModel.of_mesh(part, 1.0))
    bad = fit_part(cloud, PartModel.of_mesh(mirrored, 1.0))
    for fit in (good, bad):
        assert np.linalg.det(fit.pose[:3, :3]) == pytest.approx(1)
    assert bad.residual > 1.3 * good.residual


def test_a_part_of_another_size_or_shape_fits_worse(rng):
    part = angle()
    cloud = view(part, (1, 1, 1), rng)
    right = fit_part(cloud, PartModel.of_mesh(part, 1.0)).residual
    for other in (angle(0.1), angle(0.06), trimesh.creation.box((0.08, 0.04, 0.05))):
        assert fit_part(cloud, PartModel.of_mesh(other, 1.0)).residual > 1.3 * right


def test_the_same_scan_gives_the_same_fit(rng):
    model = PartModel.of_mesh(angle(), 1.0)
    cloud = view(angle(), (1, 0.3, 1), rng)
    one, two = (fit_part(cloud, model) for _ in range(2))
    assert np.array_equal(one.pose, two.pose)


def test_a_model_in_millimetres_is_brought_to_metres():
    model = PartModel.of_mesh(trimesh.creation.box((60, 40, 20)), 0.001)
    assert np.abs(model.points).max() == pytest.approx(0.03, rel=0.01)
    assert np.linalg.norm(model.normals, axis=1) == pytest.approx(np.ones(len(model.normals)))


def test_a_part_on_a_table_is_found_in_its_resting_pose(rng):
    part = angle()
    turn = Rotation.from_euler("z", 100, degrees=True).as_matrix()
    cloud = view(part, (-0.7, -0.2, 1.7), rng) @ turn.T + [0.3, -0.2, 1.0]
    fit = fit_part(cloud, PartModel.of_mesh(part, 1.0), resting=np.eye(3)[None])
    off = trimesh.transform_points(part.vertices, fit.pose) - (
        part.vertices @ turn.T + [0.3, -0.2, 1]
    )
    assert np.linalg.norm(off, axis=1).max() < 0.004


@pytest.mark.parametrize("count", [1, 5])
def test_too_few_points_are_refused(count):
    with pytest.raises(InputError, match="6 points"):
        fit_part(np.zeros((count, 3)), PartModel.of_mesh(angle(), 1.0))


def test_familiarity_of_known_objects_is_uniform_and_falls_with_the_residual(rng):
    def draw():
        """Answers that are less sure are also fitted worse."""
        familiar = rng.random(4000)
        return familiar, rng.gamma(2.0, 0.004 - 0.003 * familiar)

    familiar, residuals = draw()
    levels = np.linspace(0, 1, 101)
    quantiles = tuple(np.quantile(residuals, levels).tolist())
    joint = np.quantile(familiar + worse(quantiles, residuals), levels)
    cad = Cad((), quantiles, tuple(joint.tolist()))
    shares = [cad.familiarity(*pair) for pair in zip(*draw(), strict=True)]
    assert np.mean(np.less(shares, 0.05)) == pytest.approx(0.05, abs=0.015)
    assert kstest(shares, "uniform").statistic < 0.04
    falling = [cad.familiarity(0.5, residual) for residual in np.linspace(0, max(residuals), 50)]
    assert (np.diff(falling) <= 0).all()
    assert falling[0] > 0.6 > 0.4 > falling[-1]


def test_without_measured_residuals_the_answer_alone_counts():
    assert Cad(()).familiarity(0.3, 1.0) == 0.3
