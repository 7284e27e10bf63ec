"""The forest: its descriptor's laws, its trees against scikit-learn's, and what it learns."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from qs3.errors import InputError
from qs3.forest import describe, fit_forest
from qs3.forest.forest import LEAF, TREES
from qs3.geometry import rotation_z

PARTS = {
    "block": trimesh.creation.box((0.06, 0.04, 0.02)),
    "rod": trimesh.creation.cylinder(0.01, 0.08),
    "large block": trimesh.creation.box((0.09, 0.06, 0.03)),
}


def clouds(name, count, rng, points=600):
    return [PARTS[name].sample(points, seed=int(rng.integers(2**31))) for _ in range(count)]


def learnt(rng, up=True):
    source = [cloud for name in PARTS for cloud in clouds(name, 12, rng)]
    labels = np.repeat(np.arange(3), 12)
    return describe(source, up), labels


@pytest.mark.parametrize("up", [True, False])
def test_the_descriptor_does_not_depend_on_turns_shifts_and_the_order_of_points(rng, up):
    (cloud,) = clouds("block", 1, rng)
    turn = rotation_z(0.7) if up else Rotation.random(random_state=1).as_matrix()
    other = cloud @ turn[:3, :3].T + [3.0, -2.0, 1.0]
    one, two = describe([cloud, other[rng.permutation(len(other))]], up)
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


def test_upright_and_lying_differ_with_up_alone(rng):
    (rod,) = clouds("rod", 1, rng)
    lying = rod[:, [2, 0, 1]]
    upright, flat = describe([rod, lying])
    assert abs(upright[2] - flat[2]) > 1  # log of the height
    upright, flat = describe([rod, lying], up=False)
    assert np.abs(upright - flat).max() < 0.06


def test_tiny_clouds_have_finite_descriptors():
    for cloud in (np.zeros((1, 3)), np.zeros((5, 3)), np.eye(3)):
        assert np.isfinite(describe([cloud])).all()


def test_the_trees_answer_as_scikit_learn_s_do(rng):
    from sklearn.ensemble import ExtraTreesClassifier

    x, labels = learnt(rng)
    weights = rng.uniform(0.5, 2, len(labels))
    forest = fit_forest(x, labels, tuple(PARTS), weights, seed=3)
    totals = np.bincount(labels, weights=weights)
    balanced = weights * (totals.sum() / 3 / totals)[labels]
    reference = ExtraTreesClassifier(TREES, min_samples_leaf=LEAF, random_state=3)
    reference.fit(x.astype(np.float32), labels, sample_weight=balanced)
    other, _ = learnt(np.random.default_rng(1))
    assert forest._trees(other.astype(np.float32)) == pytest.approx(
        reference.predict_proba(other.astype(np.float32)), abs=1e-6
    )


def test_the_linear_rule_is_scikit_learn_s_with_the_same_covariance(rng):
    """On standardised features, LDA with a given covariance is what we solve."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.preprocessing import StandardScaler

    from qs3.forest.forest import _SHRINKAGE, _linear

    x, labels = learnt(rng)
    weights, bias = _linear(x, labels, np.ones(len(x)), 3)
    scaler = StandardScaler().fit(x)
    used = scaler.scale_ > 1e-9
    rule = LinearDiscriminantAnalysis(solver="lsqr", shrinkage=_SHRINKAGE, priors=[1 / 3] * 3)
    rule.fit(scaler.transform(x), labels)
    ours, its = x @ weights.T + bias, rule.decision_function(scaler.transform(x))
    assert used.sum() > 30
    ours, its = ours - ours.mean(axis=1, keepdims=True), its - its.mean(axis=1, keepdims=True)
    # scikit-learn standardises within classes again; ours shrinks towards the mean variance.
    assert np.corrcoef(ours.ravel(), its.ravel())[0, 1] > 0.99


def test_it_tells_parts_apart_by_shape_and_size(rng):
    x, labels = learnt(rng)
    forest = fit_forest(x, labels, tuple(PARTS))
    other, truth = learnt(np.random.default_rng(5))
    probabilities = forest.predict_proba(other)
    assert probabilities.sum(axis=1) == pytest.approx(np.ones(len(other)))
    assert (probabilities.argmax(axis=1) == truth).mean() == 1


def test_the_same_seed_gives_the_same_forest(rng):
    x, labels = learnt(rng)
    one, two = (fit_forest(x, labels, tuple(PARTS), seed=2) for _ in range(2))
    assert np.array_equal(one.predict_proba(x), two.predict_proba(x))


def test_classes_weigh_alike_whatever_their_number(rng):
    """Doubling every cloud of a class is doubling its weights, which are balanced again."""
    x, labels = learnt(rng)
    twice = np.concatenate([np.arange(len(x)), np.flatnonzero(labels == 0)])
    weights = np.where(labels == 0, 2.0, 1.0)
    one = fit_forest(x, labels, tuple(PARTS), weights)
    two = fit_forest(x[twice], labels[twice], tuple(PARTS))
    assert one.weights == pytest.approx(two.weights, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("labels", [np.zeros(6, int), np.array([0, 0, 0, 1, 1, 1])])
def test_a_class_without_a_cloud_is_refused(rng, labels):
    x = rng.normal(size=(6, 60))
    with pytest.raises(InputError, match=r"class .* has no cloud"):
        fit_forest(x, labels, ("a", "b", "c"))
    with pytest.raises(InputError, match="two classes"):
        fit_forest(x, np.zeros(6, int), ("a",))
