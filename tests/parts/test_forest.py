"""The forest: its descriptor's laws, its trees against scikit-learn's, and what it learns."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from qs3.errors import InputError
from qs3.parts import describe, describe_varied, fit_forest
from qs3.parts.descriptor import WIDTH
from qs3.parts.forest import LEAF, TREES
from qs3.parts.loaded_forest import cleaned

PARTS = {
    "block": trimesh.creation.box((0.06, 0.04, 0.02)),
    "rod": trimesh.creation.cylinder(0.01, 0.08),
    "large block": trimesh.creation.box((0.09, 0.06, 0.03)),
}


def clouds(name, count, rng, points=600):
    return [PARTS[name].sample(points, seed=int(rng.integers(2**31))) for _ in range(count)]


def learnt(rng):
    source = [cloud for name in PARTS for cloud in clouds(name, 12, rng)]
    labels = np.repeat(np.arange(3), 12)
    return describe(source), labels


def test_the_descriptor_does_not_depend_on_turns_shifts_and_the_order_of_points(rng):
    (cloud,) = clouds("block", 1, rng)
    other = cloud @ Rotation.random(random_state=1).as_matrix().T + [3.0, -2.0, 1.0]
    one, two = describe([cloud, other[rng.permutation(len(other))]])
    size = 8
    assert one[:size] == pytest.approx(two[:size], abs=1e-6)
    assert np.abs(one - two).max() < 0.06  # pairs are drawn anew: a histogram of 4,000


def test_the_descriptor_knows_the_size_in_metres(rng):
    (cloud,) = clouds("block", 1, rng)
    one, two = describe([cloud, cloud * 1.5])
    assert two[:6] - one[:6] == pytest.approx(np.full(6, np.log(1.5)), abs=1e-6)
    assert two[6:8] == pytest.approx(one[6:8], abs=1e-6)


def test_repeated_points_change_nothing(rng):
    (cloud,) = clouds("rod", 1, rng)
    one, two = describe([cloud, np.concatenate([cloud, cloud[:100]])])
    assert np.array_equal(one, two)


def test_tiny_clouds_have_finite_descriptors():
    for cloud in (np.zeros((1, 3)), np.zeros((5, 3)), np.eye(3)):
        assert np.isfinite(describe([cloud])).all()


def test_the_trees_answer_as_scikit_learn_s_do(rng):
    from sklearn.ensemble import ExtraTreesClassifier

    x, labels = learnt(rng)
    weights = rng.uniform(0.5, 2, len(labels))
    forest = fit_forest(x[None], labels, tuple(PARTS), weights, seed=3)
    totals = np.bincount(labels, weights=weights)
    balanced = weights / totals[labels] * (len(labels) / 3)
    reference = ExtraTreesClassifier(TREES, min_samples_leaf=LEAF, random_state=3)
    reference.fit(x.astype(np.float32), labels, sample_weight=balanced)
    other, _ = learnt(np.random.default_rng(1))
    assert forest._trees(other.astype(np.float32)) == pytest.approx(
        reference.predict_proba(other.astype(np.float32)), abs=1e-6
    )


def test_varied_copies_are_near_their_cloud_and_the_first_row_is_it(rng):
    some = [cloud for name in PARTS for cloud in clouds(name, 4, rng)]
    varied = describe_varied(some, seed=1)
    assert np.array_equal(varied[0], describe(some))
    assert np.array_equal(varied, describe_varied(some, seed=1))
    assert not np.array_equal(varied[1], describe_varied(some, seed=2)[1])
    lengths = np.exp(varied[1:, :, 3:6] - varied[0, :, 3:6])  # extents in order of size
    assert (lengths[..., 0] > 0.8).all()
    assert (lengths[..., 0] < 1.1).all()
    assert describe_varied([np.zeros((2, 3))]).shape[1:] == (1, WIDTH)


def test_some_copies_are_one_piece_of_a_scan_in_pieces(rng):
    """A tube that is seen on two sides is seen on one side alone in other scans."""
    sides = rng.uniform(-1, 1, (400, 3)) * [5e-3, 2e-3, 5e-3]
    apart = np.array([0, 0.015, 0])
    tube = np.concatenate([sides[:220] + apart, sides[220:] - apart])
    varied = describe_varied([tube] * 40)
    assert np.array_equal(varied, describe_varied([np.concatenate([tube, tube])] * 40))
    longest = np.exp(varied[1:, :, 3])
    pieces = longest < 0.02
    assert 0.3 < pieces.mean() < 0.7
    assert (longest[~pieces] > 0.025).all()
    whole = describe_varied([sides] * 40)
    assert (np.exp(whole[1:, :, 3]) > 0.008).all()


@pytest.mark.parametrize("labels", [np.zeros(6, int), np.array([0, 0, 0, 1, 1, 1])])
def test_a_class_without_a_cloud_is_refused(rng, labels):
    x = rng.normal(size=(1, 6, WIDTH))
    with pytest.raises(InputError, match=r"class .* has no cloud"):
        fit_forest(x, labels, ("a", "b", "c"))
    with pytest.raises(InputError, match="two classes"):
        fit_forest(x, np.zeros(6, int), ("a",))


def test_a_forest_sees_all_of_a_thin_part_and_no_wall_far_behind_it() -> None:
    plate, wire = np.mgrid[:60, :40].reshape(2, -1), np.mgrid[20:21, 40:120].reshape(2, -1)
    part = np.vstack([np.hstack([plate, wire]), np.zeros(2480)]).T.astype(np.float32) / 1000
    wall = part[:100] + np.float32([0, 0, 2])
    np.testing.assert_array_equal(cleaned(np.vstack([part, wall])), part)
