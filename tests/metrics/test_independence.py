"""The criterion of independence: known answers, and what they must not depend on."""

import numpy as np
import pytest

from jaxunshear.metrics.independence import PERMUTATIONS, compute_hsic

RNG = np.random.default_rng(0)


def test_hsic_sees_what_no_correlation_does():
    x = RNG.normal(size=(200, 1))
    square, noise = np.square(x), RNG.normal(size=(200, 1))
    assert abs(np.corrcoef(x[:, 0], square[:, 0])[0, 1]) < 0.3
    statistic, p = compute_hsic(x, square)
    assert p == 1 / (1 + PERMUTATIONS) and statistic > 0.1
    assert compute_hsic(x, noise)[1] > 0.05
    assert compute_hsic(x, x)[0] == pytest.approx(1)


def test_hsic_does_not_depend_on_scale_place_or_order():
    x, y = RNG.normal(size=(60, 3)), RNG.normal(size=(60, 2))
    y[:, 0] += x[:, 0]
    order = RNG.permutation(60)
    plain = compute_hsic(x, y)[0]
    for pair in ((7 * x + 3, y / 9 - 1), (x[order], y[order]), (y, x)):
        assert compute_hsic(*pair)[0] == pytest.approx(plain, rel=1e-9)


def test_p_is_uniform_if_nothing_is_shared():
    draws = RNG.normal(size=(60, 2, 30, 2))
    p = np.array([compute_hsic(*pair, seed)[1] for seed, pair in enumerate(draws)])
    assert 0.35 < np.mean(p) < 0.65 and np.mean(p < 0.1) < 0.25


def test_what_cannot_be_asked():
    assert compute_hsic(np.ones((9, 2)), RNG.normal(size=(9, 2))) == (0.0, 1.0)
    for one, other in ((np.ones((3, 1)), np.ones((3, 1))), (np.ones((5, 1)), np.ones((6, 1)))):
        with pytest.raises(ValueError, match="at least 4"):
            compute_hsic(one, other)
