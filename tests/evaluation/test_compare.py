import numpy as np
import pytest
from scipy import stats

from qs3.evaluation.metrics import compare_seeds


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
