"""Scores of codes on known answers, and the criterion of independence."""

import numpy as np
import pytest

from jaxunshear.metrics.disentanglement import (
    PERMUTATIONS,
    Blocks,
    compute_hsic,
    score_dci,
    score_mig,
    score_sap,
)

RNG = np.random.default_rng(0)
POSE, SLIDE = RNG.uniform(-1, 1, (3000, 2)), RNG.uniform(-1, 1, (3000, 2))
NOISE = RNG.uniform(-1, 1, (3000, 4))
OWNER = np.array([0, 0, 1, 1])
FACTORS = np.concatenate([POSE, SLIDE], axis=1)


def make_blocks(pose_code, shear_code):
    block = np.repeat([0, 1], [pose_code.shape[1], shear_code.shape[1]])
    codes = np.concatenate([pose_code, shear_code], axis=1)
    return Blocks(codes, block, FACTORS, OWNER)


def scores(pose_code, shear_code):
    blocks = make_blocks(pose_code, shear_code)
    train, test = (
        Blocks(blocks.codes[rows], blocks.block, blocks.factors[rows], blocks.owner)
        for rows in (slice(0, 2000), slice(2000, None))
    )
    return score_mig(train), score_sap(train, test), score_dci(train, test)


def test_codes_that_hold_their_own_factors_score_one():
    mig, sap, dci = scores(POSE, SLIDE)
    assert mig > 0.95 and sap == pytest.approx(1, abs=1e-3)
    assert dci["disentanglement"] > 0.9 and dci["completeness"] > 0.9
    assert dci["informativeness"] > 0.98


def test_codes_that_both_hold_everything_score_next_to_nothing():
    mig, sap, dci = scores(FACTORS, FACTORS.copy())
    assert mig == pytest.approx(0, abs=1e-9) and sap == pytest.approx(0, abs=1e-9)
    assert dci["disentanglement"] < 0.05 and dci["completeness"] < 0.1
    assert dci["informativeness"] > 0.98


def test_noise_scores_nothing_and_exchanged_codes_score_below_zero():
    mig, sap, dci = scores(NOISE[:, :2], NOISE[:, 2:])
    assert abs(mig) < 0.02 and abs(sap) < 0.02 and dci["informativeness"] < 0.05
    mig, sap, _ = scores(SLIDE, POSE)
    assert mig < -0.95 and sap == pytest.approx(-1, abs=1e-3)


def test_scores_do_not_depend_on_the_scale_of_a_code():
    plain, scaled = scores(POSE, SLIDE), scores(1e3 * POSE + 7, 1e-3 * SLIDE)
    assert plain[0] == pytest.approx(scaled[0]) and plain[1] == pytest.approx(scaled[1])


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
