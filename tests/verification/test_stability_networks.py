"""The judge of networks at their extremes: what passes, and what does not."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.load import load_experiment
from jaxunshear.errors import UserError
from jaxunshear.metrics import images as metrics
from jaxunshear.models import distances
from jaxunshear.training import checkpoint
from jaxunshear.training.monitor import check_state
from verification import network_steps, network_trainings, network_values, stability
from verification import stability_networks as judge
from verification.network_images import (
    KINDS,
    convert_to_floats,
    corrupt_images,
    insert_nan,
    make_pairs,
)
from verification.network_trainings import SHALLOW, make_steps_case

CLEAR = (network_steps._compile.cache_clear, metrics._ms_ssim.clear_cache)
FINE = judge.CaseOutput({"values": np.ones(3)})
LINE = "x stopped: supervised not finite at step 7, of batch 6; the checkpoint of step 4 is kept"
USUAL = make_steps_case("usual", SHALLOW)
NAN = make_steps_case(
    "NaN",
    SHALLOW,
    change=network_trainings._put_nan,
    expects=(judge.STOPPED,),
    words=network_trainings._list_words(),
)


def network_cases() -> list[judge.NetworkCase]:
    return [*network_trainings.list_training_cases(), *network_values.list_value_cases()]


@pytest.fixture
def compiled_anew():
    """For what is changed beneath compiled programs."""
    for clear in CLEAR:
        clear()
    yield
    for clear in CLEAR:
        clear()


def examine(found, **more):
    """Examine a case that gives this output, or raises it."""

    def run(folder):
        if isinstance(found, Exception):
            raise found
        return found

    return judge.examine(judge.NetworkCase("network made up", run, **more))


def named(name: str) -> judge.NetworkCase:
    (case,) = [case for case in network_cases() if case.name == name]
    return case


def test_cases_are_many_and_their_names_differ():
    names = [case.name for case in network_cases()]
    assert len(names) >= 80 and len(set(names)) == len(names)
    assert all(name.startswith("network ") for name in names)


@pytest.mark.parametrize(
    ("found", "outcome", "said"),
    [
        (judge.CaseOutput({"a": {"b": [1.0, np.nan]}}), "not finite", "a.b.1"),
        (judge.CaseOutput({"a": jnp.array([np.inf], jnp.bfloat16)}), "not finite", "a"),
        (judge.CaseOutput({}), "nothing was measured", ""),
        (judge.CaseOutput({"a": 1.0}, error=0.1, bar=0.05), "off by more than allowed", ""),
        (judge.CaseOutput({"a": 1.0}, error=np.nan, bar=0.05), "off by more than allowed", ""),
        (judge.CaseOutput({"a": 1.0}, {"b": np.ones(2)}), "hides a NaN", "b"),
        (judge.CaseOutput({"a": 1.0}, wrong="DS was built"), "wrong", "DS was built"),
        (ZeroDivisionError(), "crashed", "ZeroDivisionError"),
    ],
)
def test_what_is_wrong_does_not_pass(found, outcome, said):
    row = examine(found)
    assert row.outcome == outcome and said in row.said and not row.holds
    assert stability.select_failed([row]) == [row]
    text = stability.format_table([row])
    assert "FAILED: network made up" in text and "--only" in text


@pytest.mark.parametrize(
    ("expects", "line", "holds"),
    [
        ((judge.STOPPED,), LINE, True),
        ((judge.FINITE, judge.STOPPED), LINE, True),
        ((judge.FINITE,), LINE, False),
        ((judge.STOPPED,), "stopped", False),
        ((judge.STOPPED,), LINE.replace("batch 6", "something"), False),
        ((judge.STOPPED,), LINE.replace("; ", "\n"), False),
    ],
)
def test_a_stop_must_be_promised_and_say_where(expects, line, holds):
    row = examine(UserError(line), expects=expects, words=judge.SAYS_WHERE)
    assert row.holds == holds and row.said == line


@pytest.mark.parametrize("promise", [judge.STOPPED, judge.REFUSED])
def test_what_should_have_stopped_does_not_pass(promise):
    row = examine(FINE, expects=(promise,))
    assert row.outcome == f"neither {promise}" and not row.holds


@pytest.mark.parametrize("spoil", ["not finite", "damaged"])
def test_a_kept_checkpoint_must_be_usable(spoil):
    def run(folder: Path):
        kernel = jnp.full(3, np.nan if spoil == "not finite" else 1.0)
        state = {"average": {"params": {"E": {"kernel": kernel}}}}
        checkpoint.save(folder, 4, state, {"best_step": 4, "history": []})
        if spoil == "damaged":
            (folder / "checkpoints" / "00000004" / "record.json").write_text("{")
        raise UserError(LINE)

    row = judge.examine(judge.NetworkCase("network made up", run, expects=(judge.STOPPED,)))
    assert row.outcome == "left a checkpoint that cannot be used" and not row.holds


def test_the_papers_start_is_that_of_its_experiment():
    paper = load_experiment(Path(__file__).parents[2] / "experiments" / "paper.py")
    ours = network_trainings.PAPER
    assert paper.unshear == network_trainings.PAPER_NET
    assert paper.posenet == network_trainings.PAPER_POSENET
    shared = ("optimiser", "learning_rate", "beta1", "l1", "l2", "kernels", "ema_decay")
    for fields, theirs in (
        (("losses", "crops", "crop_px", *shared), paper.train),
        (shared, paper.train_posenet),
    ):
        assert [getattr(ours, name) for name in fields] == [
            getattr(theirs, name) for name in fields
        ]


@pytest.mark.long
def test_kernels_that_outweigh_the_loss_are_reported():
    training = replace(network_trainings.TRAINING, l1=1.0)
    heavy = judge.examine(make_steps_case("l1 1", SHALLOW, training))
    assert heavy.holds and heavy.said.startswith("l1 and l2 weigh")
    assert "kernels shrink first" in heavy.said


def test_steps_pass_with_their_figures():
    row = judge.examine(USUAL)
    assert row.outcome == judge.FINITE and row.holds and row.steps == network_steps.STEPS
    assert 0 < row.loss < 1 and row.gradient > 0 and not row.said


def test_a_nan_stops_a_training_and_the_row_says_what_is_kept():
    row = judge.examine(NAN)
    assert row.holds and row.outcome == judge.STOPPED and row.kept == network_steps.SAVED_EVERY
    assert row.said.startswith("training FOLDER stopped")


@pytest.mark.parametrize(
    ("check", "outcome"),
    [
        # the state is checked too late to name the step
        (check_state, "stopped by a line without 'step 7"),
        (lambda *_: None, "not finite"),
    ],
)
def test_a_training_that_does_not_see_is_caught(check, outcome):
    """Without its two looks the case that must stop ends with numbers that are not finite."""

    def floats(step, terms, batch, folder):
        return {name: float(value) for name, value in terms.items()}

    row = judge.examine(replace(NAN, run=partial(NAN.run, guards=(floats, check))))
    assert not row.holds and row.outcome.startswith(outcome)


@pytest.mark.parametrize(
    ("less", "case", "outcome", "said"),
    [
        (1, USUAL, "stopped, though it can be computed", "supervised"),
        (1, named("network losses, images all black"), "not finite", "supervised"),
        (0, named("network losses, equal images"), "not finite", "supervised.1"),  # the slope alone
    ],
    ids=["training", "black", "equal"],
)
def test_a_root_of_what_is_not_positive_is_caught(
    monkeypatch, compiled_anew, less, case, outcome, said
):
    def compute_root(a, b):
        return jnp.sqrt(jnp.mean((a - b) ** 2, (1, 2, 3)) - less)

    monkeypatch.setattr(distances, "compute_supervised_loss", compute_root)
    row = judge.examine(case)
    assert not row.holds and row.outcome == outcome and said in row.said


def hide_nan(x, weight):
    return jnp.where(x > 0, jnp.where(x > 0, x, 1) ** weight, 0)


@pytest.mark.parametrize(
    ("power", "name", "outcome"),
    [(jnp.power, "inverted", "not finite"), (hide_nan, "a NaN", "hides a NaN")],
    ids=["of what is negative", "that hides a NaN"],
)
def test_a_wrong_power_is_caught(monkeypatch, compiled_anew, power, name, outcome):
    monkeypatch.setattr(metrics, "_power", power)
    row = judge.examine(named(f"network ms_ssim, {name}"))
    assert not row.holds and row.outcome == outcome


@pytest.mark.parametrize(
    "part", ["codes 0:", "that cannot be", "network losses", "network ssim", "network ms_ssim"]
)
def test_cases_that_take_seconds_hold(part):
    rows = stability.run_stability([part])
    assert rows and not stability.select_failed(rows), stability.format_table(rows)
    assert all(part in row.case for row in rows)


def test_narrow_numbers_are_compared_with_wide_ones():
    images = np.random.default_rng(0).random((4, 8, 8, 1)).astype(np.float32)

    def precision(kind, images=images):
        def reported(variables, images):
            return {"unsheared": images * variables["scale"], "sheared": images}

        given = {"scale": np.float32([1 / 3])}, images
        return network_values.compare_precision(
            reported, given, ("unsheared", "sheared"), kind, 1.0
        )

    found = precision(jnp.float64)
    assert 1e-9 < found.error < 1e-6 and not found.wrong
    assert "nothing was cast" in precision(jnp.float32).wrong
    assert "nothing was compared" in precision(jnp.float64, 0 * images).wrong


def test_images_are_what_their_names_say():
    batch = make_pairs(3, 4, 32)
    assert batch["canonical"].dtype == np.uint8 and set(np.unique(batch["canonical"])) == {0, 255}
    assert (batch["canonical"] != batch["sheared"]).any((1, 2, 3)).all()
    floats = corrupt_images(convert_to_floats, batch)["canonical"]
    assert floats.dtype == np.float32 and set(np.unique(floats)) == {0, 1}
    made = {name: kind(floats) for name, kind in KINDS.items()}
    for name, values in (("constant grey", 0.5), ("all black", 0), ("all white", 1)):
        assert (made[name] == values).all()
    np.testing.assert_array_equal(made["inverted"], 1 - floats)
    assert (np.diff(made["alike"], axis=0) == 0).all()
    apart = np.count_nonzero(np.diff(made["one pixel apart"], axis=0), axis=(1, 2, 3))
    assert (apart == 2).all()  # each has its own pixel inverted
    assert np.argwhere(np.isnan(insert_nan(batch["canonical"]))).tolist() == [[1, 16, 16, 0]]


@pytest.mark.parametrize(("found", "code"), [(FINE, 0), (judge.CaseOutput({"a": np.nan}), 1)])
def test_the_command_ends_with_1_if_a_promise_is_broken(monkeypatch, verification, found, code):
    row = examine(found)
    monkeypatch.setattr(stability, "run_stability", lambda only: [row])
    answer = verification("stability", "--only", "network made up")
    assert answer.code == code and "network made up" in answer.out
