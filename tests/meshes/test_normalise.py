"""Sizes after normalisation, and the law of surface samples."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import InputError
from qs3.meshes import normalise, sample_surface


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_box_and_ball(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(9, 3)) * scale + rng.normal(size=3) * 10 * scale
    faces = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    before = mesh.vertices.copy()
    box, ball = normalise(mesh, "box"), normalise(mesh, "ball")
    assert box.extents.max() == pytest.approx(1)
    assert np.linalg.norm(ball.vertices, axis=1).max() == pytest.approx(1)
    for out in (box, ball):
        np.testing.assert_allclose(out.bounds.sum(axis=0), 0, atol=1e-9)
        # A similarity: all edges keep their ratios, nothing is turned.
        np.testing.assert_allclose(
            (out.vertices - out.vertices[0]) / out.extents.max(),
            (mesh.vertices - mesh.vertices[0]) / mesh.extents.max(),
            atol=1e-9,
        )
    assert np.array_equal(mesh.vertices, before)


def test_vertices_without_a_face_do_not_count() -> None:
    brick = trimesh.creation.box((2.0, 1.0, 1.0))
    stray = trimesh.Trimesh(
        np.vstack([brick.vertices, [[100.0, 0, 0]]]), brick.faces, process=False
    )
    np.testing.assert_allclose(normalise(stray).vertices[:8], brick.vertices / 2)


def test_samples_are_uniform_by_area() -> None:
    # One face a thousand times smaller, one big: the share of points follows the area.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [0.5, 0, 5], [0, 0.5, 5]])
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [3, 4, 5]], process=False)
    points = sample_surface(mesh, 40_000, np.random.default_rng(0))
    assert points.dtype == np.float32
    top = points[:, 2] > 2
    assert top.mean() == pytest.approx(0.2, abs=0.01)
    low = points[~top]
    assert (low[:, :2] >= 0).all() and (low[:, :2].sum(axis=1) <= 1 + 1e-6).all()
    # The mean of a triangle is its centroid, and a quarter of it lies beyond half its height.
    np.testing.assert_allclose(low.mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.01)
    assert (low[:, 0] > 0.5).mean() == pytest.approx(0.25, abs=0.01)


def test_what_has_no_size_is_refused() -> None:
    point = trimesh.Trimesh(np.ones((3, 3)), [[0, 1, 2]], process=False)
    with pytest.raises(InputError, match="one place"):
        normalise(point)
    with pytest.raises(InputError, match="no face with an area"):
        sample_surface(point, 3, np.random.default_rng(0))
    empty = trimesh.Trimesh()
    with pytest.raises(InputError, match="without faces"):
        normalise(empty)
