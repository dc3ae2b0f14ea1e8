"""Probes find a quantity in a code, however small its variance, and nothing where nothing is."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.splits import SPLITS
from jaxunshear.evaluation import probes
from jaxunshear.evaluation.codes import split_by_slip
from jaxunshear.evaluation.leakage import probe_quantity
from jaxunshear.evaluation.probe_data import ProbeSplit, estimate_slides
from jaxunshear.evaluation.probes import FAMILIES, compute_r2, fit_whitening, prepare_task

COUNT, LEARNT = 1200, 800  # of the planted leak


def score(probe, codes, wanted):
    """Return R2 on the last third, after learning from the first two."""
    cut = 2 * len(codes) // 3
    task = prepare_task(codes[:cut], wanted[:cut], codes[cut:], np.arange(cut))
    answers = task.unscale(FAMILIES[probe](task))
    true = wanted[cut:]
    assert answers.shape == true.shape
    return compute_r2(np.sum((answers - true) ** 2, 1), np.sum((true - true.mean(axis=0)) ** 2, 1))


@pytest.fixture
def codes():
    return np.random.default_rng(1).normal(size=(900, 4))


def test_families_find_what_they_can_represent(codes):
    straight = codes @ np.random.default_rng(2).normal(size=(4, 2)) + 5
    least = {"linear": 0.999, "kernel ridge": 0.999, "mlp": 0.98, "trees": 0.8, "neighbours": 0.7}
    assert least.keys() == FAMILIES.keys()
    for name, bound in least.items():
        assert score(name, codes, straight) > bound, name
    bent = np.abs(codes[:, :1])
    assert score("linear", codes, bent) < 0.05
    assert score("mlp", codes, bent) > 0.9 and score("trees", codes, bent) > 0.9
    assert score("kernel ridge", codes, bent) > 0.7


@pytest.mark.parametrize("probe", FAMILIES)
def test_a_direction_of_small_variance_counts_as_much_as_a_wide_one(probe, codes):
    wanted = codes[:, :1] + codes[:, 1:2]
    plain = score(probe, codes, wanted)
    narrow = codes * [1e-4, 1, 1, 1] + [1e3, 0, 0, 0]
    assert score(probe, narrow, wanted) == pytest.approx(plain, abs=0.02)
    constant = np.concatenate([codes, np.full((900, 1), 3.0)], axis=1)
    assert score(probe, constant, wanted) == pytest.approx(plain, abs=0.02)


@pytest.mark.parametrize("probe", FAMILIES)
def test_nothing_is_found_where_nothing_is(probe, codes):
    foreign = np.random.default_rng(3).normal(size=(900, 1))
    assert -0.15 < score(probe, codes, foreign) < 0.05


def plant_leak(rng, count):
    """Make codes (N, 16) of a pose, with a slide in two directions of 1 % of the spread."""
    pose, slide = rng.uniform(-1, 1, (count, 3)), rng.uniform(-1, 1, (count, 2))
    bends = np.concatenate([pose, np.sin(3 * pose), pose**2, pose[:, :1] * pose[:, 1:]], axis=1)
    mix = np.random.default_rng(7)
    return bends @ mix.normal(size=(11, 16)) + 0.02 * slide @ mix.normal(size=(2, 16)), slide


def test_a_planted_leak_is_found_though_a_probe_of_scaled_numbers_misses_it():
    """The probe of version 0.2.0 scaled each number, and stopped early for five quantities."""
    rng = np.random.default_rng(0)
    codes, slide = plant_leak(rng, COUNT)
    hidden = rng.uniform(-1, 1, (COUNT, 3))  # quantities that no code holds
    wanted = np.concatenate([slide, hidden], axis=1)
    wanted /= wanted.std(axis=0)
    scaled = (codes - codes.mean(axis=0)) / codes.std(axis=0)
    held = np.arange(LEARNT) % 5 == 4
    learnt, judged = np.flatnonzero(~held), np.flatnonzero(held)
    parts = (scaled[learnt], wanted[learnt], scaled[judged], wanted[judged], scaled[LEARNT:])
    old = probes._train_mlp(*(jnp.asarray(part, jnp.float32) for part in parts), gaussian=False)
    true = wanted[LEARNT:]
    off = np.square(np.asarray(old) - true).sum(axis=0)
    scores = 1 - off / np.square(true - true.mean(axis=0)).sum(axis=0)
    assert scores.mean() < 0.1
    for column in (0, 1, 2):  # both planted quantities, and one that no code holds
        one = wanted[:, column : column + 1]
        parts = (codes[:LEARNT], codes[LEARNT:]), one[:LEARNT], one[LEARNT:], np.arange(LEARNT)
        found = probe_quantity(*parts)
        assert found.r2 > 0.9 if column < 2 else found.r2 < 0.05


def test_whitened_codes_have_unit_covariance_and_keep_no_rounding_noise():
    rng = np.random.default_rng(4)
    codes = rng.normal(size=(500, 3)) @ rng.normal(size=(3, 10)) + 5
    noisy = codes.astype(np.float32) + np.float32(1e-7) * rng.normal(size=codes.shape)
    white = fit_whitening(noisy).apply(noisy)
    assert white.shape == (500, 3)
    np.testing.assert_allclose(np.cov(white.T), np.eye(3), atol=1e-6)


@pytest.mark.parametrize("probe", FAMILIES)
def test_the_same_bits_again(probe, codes):
    task = prepare_task(codes[:300], np.sin(codes[:300, :1]), codes[600:], np.arange(300))
    np.testing.assert_array_equal(FAMILIES[probe](task), FAMILIES[probe](task))


def test_r2_of_known_answers():
    truth = np.random.default_rng(0).normal(size=500)
    scatter = np.square(truth - truth.mean())
    assert compute_r2(np.zeros(500), scatter) == 1
    assert compute_r2(scatter, scatter) == 0
    assert compute_r2(scatter / 4, scatter) == pytest.approx(0.75)
    assert np.isnan(compute_r2(np.zeros(3), np.zeros(3)))


RNG = np.random.default_rng(0)
COUNTS = dict(zip(SPLITS, (1500, 600, 900), strict=True))


def make_split(codes, slides, batch):
    """Make slides with their pose in no code, `slides` (N, K) in x and y mm."""
    features = {"z_p": codes[:, :0], "z_s": codes}
    names = [("slide", f"slide_{axis}_mm") for axis in "xy"[: slides.shape[1]]]
    quantities = {name: slides[:, [column]] for column, name in enumerate(names)}
    return ProbeSplit(features, quantities, np.arange(len(codes)), batch)


def test_intervals_hold_95_percent_and_widen_with_doubt():
    """The noise of the codes grows with their last number, and the doubtful slides have slipped."""
    splits = {}
    for name, count in COUNTS.items():
        slide = RNG.uniform(-2.5, 2.5, (count, 2))
        doubt = RNG.uniform(0, 1, (count, 1))
        noise = 0.05 * (1 + 9 * doubt) * RNG.normal(size=(count, 2))
        slips = doubt[:, 0] > 0.5
        state = {"stuck": 1 - slips, "slipping": slips.astype(int)}
        splits[name] = make_split(np.concatenate([slide + noise, doubt], axis=1), slide, state)
    found = {(row["name"], row["part"]): row for row in estimate_slides(splits)}
    for axis in "xy":
        every, sure, unsure = (
            found.pop((f"slide_{axis}_mm", part)) for part in ("all", "sticking", "slipped")
        )
        assert 0.93 < every["coverage"] < 0.97
        assert sure["coverage"] > 0.9 and unsure["coverage"] > 0.9
        assert unsure["half_width"] > 1.5 * sure["half_width"] and unsure["mae"] > 1.5 * sure["mae"]
        low, high = every["coverage interval"]
        assert low <= every["coverage"] <= high and every["rmse"] >= every["mae"] > 0
        assert sure["slides"] + unsure["slides"] == every["slides"] == COUNTS["test"]
        # no reader of these codes can do better than their noise, .05 to .5 mm
        assert 0.2 < every["mae"] < 0.35
    assert not found


def test_what_no_code_gives_is_covered_all_the_same():
    splits = {}
    for name, count in COUNTS.items():
        slides = RNG.uniform(-1, 1, (count, 1))
        splits[name] = make_split(RNG.normal(size=(count, 3)), slides, {})
    (row,) = estimate_slides(splits)
    assert 0.92 < row["coverage"] < 0.98 and row["half_width"] > 0.85
    assert row["mae"] == pytest.approx(0.5, abs=0.06)


def test_slipped_is_where_all_that_touches_slips():
    state = {"stuck": np.array([0, 1, 50, 0]), "slipping": np.array([100, 99, 50, 0])}
    parts = split_by_slip(state)
    assert parts["slipped"].tolist() == [True, True, False, False]
    assert parts["sticking"].tolist() == [False, False, True, True]
