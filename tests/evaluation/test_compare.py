import numpy as np
import pytest
from scipy import stats

from qs3.evaluation.compare import compare_seeds, mcnemar


def test_the_paired_interval_is_that_of_the_t_test():
    rng = np.random.default_rng(0)
    first, second = rng.random(5), rng.random(5)
    result = compare_seeds(dict(enumerate(first)), dict(enumerate(second)) | {9: 1.0})
    expected = stats.ttest_rel(first, second).confidence_interval(0.95)
    assert result is not None and result.n == 5
    assert result.mean == pytest.approx((first - second).mean())
    assert result.interval == pytest.approx((expected.low, expected.high))
    assert compare_seeds({0: 1.0}, {1: 1.0}) is None
    single = compare_seeds({0: 0.5}, {0: 0.25})
    assert single is not None and single.interval is None and single.mean == 0.25
    assert single.format() == "+25.0 points (one seed, no interval)"


def test_the_clouds_on_which_two_networks_differ_are_a_fair_coin_s_between_equals():
    rng = np.random.default_rng(1)
    first, second = rng.random(40) < 0.5, rng.random(40) < 0.8
    result = mcnemar(first, second)
    n, k = result.first_only + result.second_only, min(result.first_only, result.second_only)
    assert result.second_only - result.first_only == second.sum() - first.sum()
    assert result.p == pytest.approx(min(1.0, 2 * stats.binom.cdf(k, n, 0.5)))
    assert mcnemar(second, first).p == result.p
    assert mcnemar(first, first).p == 1.0
