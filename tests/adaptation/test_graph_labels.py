"""Laws of the refinement of pseudo labels on a graph of neighbours."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import softmax
from sklearn.neighbors import NearestNeighbors

from qs3.adaptation import graph_labels
from qs3.adaptation.graph_labels import neighbour_graph, refine_probabilities
from qs3.errors import InputError


def example(m=30, k=4, width=5, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(m, width)), softmax(2 * rng.normal(size=(m, k)), axis=1)


sizes = st.integers(0, 40)
seeds = st.integers(0, 1000)


@given(sizes, seeds, st.integers(1, 12), st.sampled_from([0.0, 0.5, 0.99]), st.integers(0, 30))
def test_rows_stay_probabilities_within_what_was_there(m, seed, k, alpha, iterations):
    features, rows = example(m, seed=seed)
    refined = refine_probabilities(features, rows, k, alpha, iterations)
    assert refined.shape == rows.shape
    assert refined.sum(axis=1) == pytest.approx(np.ones(m), abs=1e-9)
    if m:
        # A weighted mean lies between the smallest and the largest.
        assert (refined >= rows.min(axis=0) - 1e-12).all()
        assert (refined <= rows.max(axis=0) + 1e-12).all()


@given(sizes, seeds)
def test_constant_probabilities_stay(m, seed):
    features, _ = example(m, seed=seed)
    rows = np.tile([0.7, 0.2, 0.1], (m, 1))
    assert np.allclose(refine_probabilities(features, rows), rows, rtol=0, atol=1e-12)


@given(sizes, seeds)
def test_without_neighbours_or_steps_nothing_changes(m, seed):
    features, rows = example(m, seed=seed)
    assert np.array_equal(refine_probabilities(features, rows, alpha=0.0), rows)
    assert np.array_equal(refine_probabilities(features, rows, iterations=0), rows)


@given(seeds)
def test_order_of_clouds_and_classes_does_not_matter(seed):
    features, rows = example(seed=seed)
    rng = np.random.default_rng(seed)
    order, columns = rng.permutation(30), rng.permutation(4)
    refined = refine_probabilities(features, rows, 5)
    there = refine_probabilities(features[order], rows[order][:, columns], 5)
    assert there == pytest.approx(refined[order][:, columns], abs=1e-9)


@given(seeds)
def test_length_of_the_features_does_not_matter(seed):
    features, rows = example(seed=seed)
    factor = np.random.default_rng(seed).uniform(0.1, 9.0, size=(30, 1))
    expected = refine_probabilities(features, rows, 5)
    assert refine_probabilities(factor * features, rows, 5) == pytest.approx(expected, abs=1e-9)


def test_graph_is_that_of_scikit_learn():
    features, _ = example(50)
    search = NearestNeighbors(n_neighbors=7, metric="cosine").fit(features)
    distances, ends = search.kneighbors()
    expected = np.zeros((50, 50))
    np.put_along_axis(expected, ends, np.maximum(1 - distances, 0), axis=1)
    expected = np.maximum(expected, expected.T)
    graph = neighbour_graph(features, 7)
    assert graph.toarray() == pytest.approx(expected, abs=1e-12)
    assert graph.nnz <= 2 * 7 * 50


def test_steps_are_the_formula():
    features, rows = example()
    weights = neighbour_graph(features, 5).toarray()
    walk = weights / weights.sum(axis=1, keepdims=True)
    expected = rows
    for _ in range(4):
        expected = 0.8 * walk @ expected + 0.2 * rows
    assert refine_probabilities(features, rows, 5, 0.8, 4) == pytest.approx(expected, abs=1e-12)
    # In the limit it is (1 − α)(1 − α D⁻¹ W)⁻¹ P₀.
    limit = 0.2 * np.linalg.solve(np.eye(30) - 0.8 * walk, rows)
    assert refine_probabilities(features, rows, 5, 0.8, 200) == pytest.approx(limit, abs=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_noise_in_two_clusters_is_repaired(seed):
    """A third of the labels is wrong; the graph knows the clusters, not the labels."""
    rng = np.random.default_rng(seed)
    labels = np.arange(100) % 2
    features = np.eye(2)[labels] + 0.05 * rng.normal(size=(100, 2))
    seen = np.where(rng.permutation(100) < 33, 1 - labels, labels)
    rows = 0.1 + 0.8 * np.eye(2)[seen]
    refined = refine_probabilities(features, rows, 10, 0.95, 50)
    assert (seen == labels).mean() == 0.67
    assert (refined.argmax(axis=1) == labels).mean() > 0.95


def test_in_blocks_and_in_bounded_memory(monkeypatch):
    features, rows = example(2000)
    whole = refine_probabilities(features, rows)
    monkeypatch.setattr(graph_labels, "_BLOCK", 2**17)  # 1 MiB
    tracemalloc.start()
    refined = refine_probabilities(features, rows)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert refined == pytest.approx(whole, abs=1e-12)
    assert peak < 10 * 2**20 + 2000 * 10 * 8 * 12  # blocks and the graph; all would be 32 MB


@pytest.mark.parametrize("m", [1, 2, 3])
def test_few_clouds(m):
    features, rows = example(m)
    assert refine_probabilities(features, rows, k=10).shape == (m, 4)


def test_clouds_without_similar_others_keep_their_probabilities():
    features = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]])
    rows = np.array([[0.9, 0.1], [0.2, 0.8], [0.5, 0.5]])
    assert np.array_equal(refine_probabilities(features, rows, 2), rows)


def test_equal_features_are_linked():
    rows = np.array([[0.9, 0.1]] * 4 + [[0.4, 0.6]])
    refined = refine_probabilities(np.ones((5, 3)), rows, 4)
    assert refined.argmax(axis=1).tolist() == [0] * 5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"k": 0}, "k must be at least 1"),
        ({"alpha": 1.0}, "alpha must be 0 to below 1"),
        ({"iterations": -1}, "iterations must be at least 0"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(InputError, match=message):
        refine_probabilities(*example(), **settings)


def test_inputs_are_checked():
    features, rows = example()
    with pytest.raises(InputError, match="sum to 1"):
        refine_probabilities(features, 2 * rows)
    with pytest.raises(InputError, match="features hold NaN"):
        refine_probabilities(np.full_like(features, np.nan), rows)
