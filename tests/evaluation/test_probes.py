"""Probes find what is in a code, however faint, and nothing where nothing is."""

import numpy as np
import pytest

from jaxunshear.evaluation.probes import PROBES, _solved
from jaxunshear.metrics.independence import r2


def reported(probe, codes, wanted, groups=None):
    """R2 on the last third, learnt from the first two."""
    cut = 2 * len(codes) // 3
    groups = np.arange(cut) if groups is None else groups[:cut]
    answers = PROBES[probe](codes[:cut], wanted[:cut], codes[cut:], groups)
    true = wanted[cut:]
    assert answers.shape == true.shape
    return r2(np.square(answers - true), np.square(true - true.mean(axis=0)))


@pytest.fixture
def codes():
    return np.random.default_rng(1).normal(size=(900, 4))


def test_a_linear_map_is_found_by_both_and_a_bent_one_by_the_network(codes):
    straight = codes @ np.random.default_rng(2).normal(size=(4, 2)) + 5
    assert reported("linear", codes, straight) > 0.999
    assert reported("mlp", codes, straight) > 0.98
    bent = np.abs(codes[:, :1])
    assert reported("linear", codes, bent) < 0.05
    assert reported("mlp", codes, bent) > 0.9


@pytest.mark.parametrize("probe", PROBES)
def test_a_whisper_counts_as_much_as_a_shout(probe, codes):
    wanted = codes[:, :1] + codes[:, 1:2]
    whispered = codes * [1e-6, 1, 1, 1] + [1e3, 0, 0, 0]
    assert reported(probe, whispered, wanted) > 0.98
    assert reported(probe, np.concatenate([codes, np.full((900, 1), 3.0)], axis=1), wanted) > 0.98  # what never varies


@pytest.mark.parametrize("probe", PROBES)
def test_nothing_is_found_where_nothing_is(probe, codes):
    foreign = np.random.default_rng(3).normal(size=(900, 1))
    assert -0.1 < reported(probe, codes, foreign) < 0.05


def test_more_numbers_than_examples_give_the_same_ridge():
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(30, 50)), rng.normal(size=(30, 2))
    full = np.linalg.solve(x.T @ x + 0.1 * 30 * np.eye(50), x.T @ y)
    np.testing.assert_allclose(_solved(x, y, 0.1), full, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(_solved(x[:, :20], y, 0.0), np.linalg.lstsq(x[:, :20], y, rcond=None)[0], rtol=1e-8)


def test_the_same_bits_again(codes):
    wanted = np.sin(codes[:, :1])
    first, again = (PROBES["mlp"](codes[:600], wanted[:600], codes[600:], np.arange(600)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
