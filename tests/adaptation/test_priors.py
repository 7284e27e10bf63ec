"""Laws of the estimates of the class prior."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import minimize

from qs3.adaptation.priors import estimate_prior_bbse, estimate_prior_em, project_to_simplex
from qs3.errors import InputError


@given(st.integers(2, 6), st.randoms(use_true_random=False))
def test_bbse_inverts_the_confusion(k, random):
    rng = np.random.default_rng(random.getrandbits(32))
    prior = rng.dirichlet(np.ones(k))
    confusion = rng.integers(0, 5, size=(k, k)) + 40 * np.eye(k, dtype=np.int64)
    within = confusion / confusion.sum(axis=1, keepdims=True)
    assert estimate_prior_bbse(confusion, prior @ within) == pytest.approx(prior, abs=1e-9)


def test_bbse_is_the_authors_weights_times_the_source_prior():
    confusion = np.array([[50, 5, 1], [2, 20, 3], [4, 1, 70]])
    predicted = np.array([0.3, 0.2, 0.5])
    joint = confusion.T / confusion.sum()
    source = confusion.sum(axis=1) / confusion.sum()
    expected = np.linalg.solve(joint, predicted) * source
    assert (expected > 0).all()
    assert estimate_prior_bbse(confusion, predicted) == pytest.approx(expected, abs=1e-12)


def test_bbse_stays_on_the_simplex():
    """Predictions that no prior explains, a useless classifier, a class without source."""
    confusion = np.array([[8, 2], [2, 8]])
    assert estimate_prior_bbse(confusion, np.array([1.0, 0.0])).tolist() == [1.0, 0.0]
    useless = estimate_prior_bbse(np.array([[5, 5], [5, 5]]), np.array([30, 70]))
    assert useless == pytest.approx([0.5, 0.5])
    absent = np.array([[9, 1, 0], [1, 9, 0], [0, 0, 0]])
    assert estimate_prior_bbse(absent, np.array([50, 50, 0])) == pytest.approx([0.5, 0.5, 0.0])


@given(arrays(np.float64, st.integers(1, 6), elements=st.floats(-3, 3)))
def test_projection_is_the_nearest_point(values):
    point = project_to_simplex(values)
    assert (point >= 0).all()
    assert point.sum() == pytest.approx(1.0)
    # First-order condition: no corner lies in a direction that comes nearer.
    assert ((values - point) @ (np.eye(len(values)) - point).T <= 1e-9).all()


def shifted(prior, source_prior, m=4000, seed=0):
    """Posteriors under the source's prior of a Gaussian each class, drawn by another prior."""
    rng = np.random.default_rng(seed)
    k = len(prior)
    labels = rng.choice(k, size=m, p=prior)
    values = rng.normal(2.0 * labels, 1.0)
    joint = np.exp(-0.5 * np.square(values[:, None] - 2.0 * np.arange(k))) * source_prior
    return joint / joint.sum(axis=1, keepdims=True)


def test_em_recovers_a_shifted_prior():
    prior, source = np.array([0.6, 0.3, 0.1]), np.array([0.2, 0.3, 0.5])
    rows = shifted(prior, source)
    assert estimate_prior_em(rows, source) == pytest.approx(prior, abs=0.03)
    assert np.abs(rows.mean(axis=0) - prior).max() > 0.1  # plain counting does not


def test_em_maximises_the_likelihood():
    source = np.array([0.2, 0.3, 0.5])
    rows = shifted(np.array([0.5, 0.3, 0.2]), source, m=60)

    def cost(free):
        prior = np.exp(np.append(free, 0.0))
        return -np.log((rows / source) @ (prior / prior.sum())).sum()

    free = minimize(cost, np.zeros(2), options={"gtol": 1e-9}).x
    expected = np.exp(np.append(free, 0.0))
    prior = estimate_prior_em(rows, source, iterations=100_000, tolerance=1e-13)
    assert prior == pytest.approx(expected / expected.sum(), abs=1e-5)


@given(st.integers(0, 2**31), st.integers(2, 5), st.integers(1, 40), st.integers(0, 5))
def test_em_never_lowers_the_likelihood(seed, k, m, steps):
    rows = np.random.default_rng(seed).dirichlet(np.full(k, 0.5), size=m)
    source = np.full(rows.shape[1], 1 / rows.shape[1])

    def likelihood(count):
        prior = estimate_prior_em(rows, source, iterations=count, tolerance=0.0)
        return np.log((rows / source) @ prior).sum()

    assert likelihood(steps + 1) >= likelihood(steps) - 1e-9


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: estimate_prior_em(p, np.array([0.0, 1.0])), "positive for every class"),
        (lambda p: estimate_prior_em(p[:0], np.array([0.5, 0.5])), "no clouds"),
        (lambda p: estimate_prior_bbse(np.zeros((2, 2), np.int64), p[0]), "at least one class"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(InputError, match=message):
        call(np.array([[0.9, 0.1], [0.3, 0.7]]))
