"""Oriented boxes: laws, and the boxes of real data."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.io.extract.cut import OrientedBox, inside_box

seeds = st.integers(0, 2**32 - 1)


def drawn(seed):
    rng = np.random.default_rng(seed)
    basis = Rotation.random(random_state=rng).as_matrix()
    made = OrientedBox(rng.normal(size=3), basis, rng.uniform(0.2, 1.5, 3))
    return made, rng.normal(size=(200, 3)), rng


@given(seeds)
def test_a_turned_box_holds_the_turned_points(seed):
    box, points, rng = drawn(seed)
    turn, shift = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    moved = OrientedBox(turn @ box.centre + shift, box.basis @ turn.T, box.half)
    # Points on a face may fall to either side by rounding; drawn ones are never there.
    np.testing.assert_array_equal(
        inside_box(points, box), inside_box(points @ turn.T + shift, moved)
    )


@given(seeds)
def test_order_and_sense_of_the_axes_do_not_matter(seed):
    box, points, rng = drawn(seed)
    order, signs = rng.permutation(3), rng.choice([-1.0, 1.0], (2, 3))
    other = OrientedBox(
        box.centre, signs[0][:, None] * box.basis[order], signs[1] * box.half[order]
    )
    np.testing.assert_array_equal(inside_box(points, box), inside_box(points, other))


@given(seeds)
def test_an_upright_box_is_two_corners(seed):
    rng = np.random.default_rng(seed)
    low, size = rng.normal(size=3), rng.uniform(0.1, 2, 3)
    points = rng.normal(size=(300, 3))
    box = OrientedBox(low + size / 2, np.eye(3), size / 2)
    expected = ((points >= low) & (points <= low + size)).all(axis=1)
    np.testing.assert_array_equal(inside_box(points, box), expected)
    wider = ((points >= low - 0.2) & (points <= low + size + 0.2)).all(axis=1)
    np.testing.assert_array_equal(inside_box(points, box, margin=0.2), wider)


def test_convention_axes_are_the_rows_of_the_basis():
    axis = np.array([np.cos(0.3), np.sin(0.3), 0.0])
    basis = np.stack([axis, np.cross([0, 0, 1], axis), [0.0, 0.0, 1.0]])
    box = OrientedBox(np.zeros(3), basis, np.array([2.0, 0.1, 0.1]))
    assert inside_box(np.stack([1.9 * axis, -1.9 * axis]), box).all()
    assert not inside_box(1.9 * axis[None] * [1, -1, 1], box).any()


@pytest.mark.parametrize(
    ("basis", "half"),
    [
        (np.eye(3) * 2, np.ones(3)),
        (np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]]), np.ones(3)),
        (np.full((3, 3), np.nan), np.ones(3)),
        (np.eye(3), np.array([1.0, np.inf, 1.0])),
    ],
)
def test_what_is_no_box_is_refused(basis, half):
    with pytest.raises(InputError):
        inside_box(np.zeros((1, 3)), OrientedBox(np.zeros(3), basis, half))


@pytest.mark.data
def test_convention_boxes_of_real_objects_cut_them_out_of_one_another(shared_data):
    """Chairs that stand within a table's box are in its cloud: cutting gives just their points.

    The file has each object in the axes of its box. Boxes are (x, y, z, three half sizes, heading,
    class) in the frame's world, which is what VoteNet makes of SUN RGB-D's basis and coeffs.
    """
    data = dict(np.load(shared_data / "sunrgbd_objects.npz"))
    offset, boxes = data["offset"], data["bbox"]

    def upright_box(index, heading):
        # VoteNet counts radians from +x, clockwise seen from above.
        return OrientedBox(boxes[index, :3], rotation_z(-heading).T, boxes[index, 3:6])

    def cloud(index):
        local = data["points"][offset[index] : offset[index + 1]].astype(np.float64)
        box = upright_box(index, boxes[index, 6])
        return box, local @ box.basis + box.centre

    every = [cloud(index) for index in range(len(boxes))]
    for box, points in every:
        assert inside_box(points, box, margin=1e-5).all()
    table_box, table = every[7]
    tree = cKDTree(table)
    for index in range(7):
        box, chair = every[index]
        assert data["frame"][index] == data["frame"][7]
        assert inside_box(chair, table_box).all()
        # As many points, and the same ones to the rounding of the file.
        cut = table[inside_box(table, box, margin=1e-6)]
        assert len(cut) == len(chair)
        assert tree.query(chair)[0].max() < 1e-6
        # Turned the other way the boxes do not agree.
        other = upright_box(index, -boxes[index, 6])
        assert inside_box(table, other).sum() != len(chair)
