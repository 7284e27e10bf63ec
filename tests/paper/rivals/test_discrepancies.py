"""Gradient reversal, and distances of samples and classifiers, against plain formulae."""

import itertools

import numpy as np
import pytest
import torch

from qs3.errors import InputError
from qs3.paper.rivals.mmd import mmd
from qs3.paper.rivals.pointdan import classifier_discrepancy
from qs3.paper.rivals.reversal import reverse_gradient

SIGMAS = (0.3, 1.0, 4.0)


def samples(b=5, m=7, c=3, shift=0.5):
    rng = np.random.default_rng(0)
    return rng.normal(size=(b, c)), rng.normal(size=(m, c)) * 1.3 + shift


def kernel(u, v, sigmas):
    return sum(np.exp(-np.sum((u - v) ** 2) / (2 * s**2)) for s in sigmas)


def mmd_by_loops(x, y, sigmas):
    def within(z):
        return np.mean([kernel(u, v, sigmas) for u, v in itertools.product(z, repeat=2)])

    across = np.mean([kernel(u, v, sigmas) for u in x for v in y])
    return within(x) + within(y) - 2 * across


@pytest.mark.parametrize("far", [0.0, 1000.0])
def test_mmd_is_the_double_loop(far):
    x, y = (sample + far for sample in samples())
    value = mmd(torch.from_numpy(x), torch.from_numpy(y), SIGMAS)
    assert float(value) == pytest.approx(mmd_by_loops(x, y, SIGMAS), abs=1e-9)


def test_mmd_has_the_gradient_of_its_values():
    x, y = (torch.from_numpy(s).requires_grad_() for s in samples(4, 3, 2))
    assert torch.autograd.gradcheck(lambda u, v: mmd(u, v, SIGMAS), (x, y))


def test_classifier_discrepancy_is_the_mean_difference():
    rng = np.random.default_rng(0)
    p1, p2 = rng.dirichlet(np.ones(4), 6), rng.dirichlet(np.ones(4), 6)
    value = classifier_discrepancy(torch.from_numpy(p1), torch.from_numpy(p2))
    expected = sum(abs(p1[i, k] - p2[i, k]) for i in range(6) for k in range(4)) / 24
    assert float(value) == pytest.approx(expected)
    certain = torch.eye(4)
    assert float(classifier_discrepancy(certain, certain.roll(1, 0))) == pytest.approx(2 / 4)


def test_half_precision_and_autocast_do_not_reach_the_sums():
    x, y = (torch.from_numpy(s).to(torch.bfloat16) for s in samples())
    expected = mmd(x.double(), y.double(), [1.0])
    with torch.autocast("cpu", torch.bfloat16):
        value = mmd(x, y, [1.0])
    assert value.dtype == torch.float32
    assert float(value) == pytest.approx(float(expected), rel=1e-5)


def test_samples_that_are_too_small_are_refused():
    x = torch.zeros(1, 2)
    with pytest.raises(InputError, match="samples of 1 or more, not 0 and 1"):
        mmd(x[:0], x, [1.0])


@pytest.mark.parametrize("coefficient", [0.0, 0.3, 1.0])
def test_reversal_is_the_identity_with_the_gradient_turned_round(coefficient):
    x = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)

    def after(value):
        return (value @ weight).tanh().square().sum()

    plain = torch.autograd.grad(after(x), (x, weight))
    assert torch.equal(reverse_gradient(x, coefficient), x)
    turned = torch.autograd.grad(after(reverse_gradient(x, coefficient)), (x, weight))
    torch.testing.assert_close(turned[0], -coefficient * plain[0])
    torch.testing.assert_close(turned[1], plain[1])
    # The slope of the values themselves, by finite differences, has the other sign.
    step = torch.zeros_like(x)
    step[1, 2] = 1e-6
    slope = (after(x + step) - after(x - step)).item() / 2e-6
    assert float(turned[0][1, 2]) == pytest.approx(-coefficient * slope, abs=1e-6)
