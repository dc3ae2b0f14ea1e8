"""The line of a training that stops, and the event files of one that goes on."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.errors import UserError
from jaxunshear.training import checkpoint
from jaxunshear.training.monitor import check_state, check_terms
from jaxunshear.training.step import State

SOUND = {"image": np.full((12, 4, 4, 1), 255, np.uint8), "pose": np.full((12, 4), -3.5, np.float32)}
TERMS = {"gradient": jnp.asarray(1.0), "patch": jnp.asarray(0.5), "supervised": jnp.asarray(0.25)}


def line(tmp_path, terms, batch=SOUND):
    terms = {name: jnp.asarray(value) for name, value in terms.items()}
    with pytest.raises(UserError) as stop:
        check_terms(7, TERMS | terms, batch, tmp_path / "run")
    said = str(stop.value)
    assert "\n" not in said and "at step 7, of batch 6 (batches(6) begins with it again)" in said
    return said


def test_finite_terms_come_back_as_floats(tmp_path):
    expected = {"gradient": 1.0, "patch": 0.5, "supervised": 0.25}
    assert check_terms(7, TERMS, SOUND, tmp_path) == expected


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("broken", "named"),
    [
        (("supervised", "gradient"), "supervised"),
        (("supervised", "patch"), "patch, supervised"),
        (("gradient",), "gradient"),
    ],
)
def test_the_terms_are_named_and_the_gradient_only_if_it_is_alone(tmp_path, value, broken, named):
    assert f"stopped: {named} not finite" in line(tmp_path, dict.fromkeys(broken, value))


def test_a_sound_batch_points_to_the_learning_rate(tmp_path):
    said = line(tmp_path, {"patch": np.nan})
    assert "whose numbers are -3.5 to 255;" in said
    assert "lower learning_rate" in said and "fix the data" not in said


def test_broken_examples_are_named_and_many_are_cut_short(tmp_path):
    batch = {name: values.astype(np.float32) for name, values in SOUND.items()}
    batch["image"][[2, 9], 1, 1] = np.nan
    batch["pose"][:, 3] = np.inf
    said = line(tmp_path, {"patch": np.nan}, batch)
    assert "in image of examples 2, 9; pose of examples 0, 1, 2, 3, 4, 5, 6, 7, ...;" in said
    assert "fix the data" in said and "learning_rate" not in said


@pytest.mark.parametrize("part", ["params", "batch_stats", "optimiser", "average"])
def test_any_part_of_the_state_is_checked_at(tmp_path, part):
    sound = State(jnp.asarray(7), *({"E": {"kernel": jnp.ones(3)}} for _ in range(4)))
    check_state(sound, 7, SOUND, tmp_path)
    spoilt = sound._replace(**{part: {"E": {"kernel": jnp.array([1.0, np.inf, 0.0])}}})
    with pytest.raises(UserError, match=rf"stopped: {part}\.E\.kernel not finite at step 7"):
        check_state(spoilt, 7, SOUND, tmp_path)


def test_what_is_kept_is_said(tmp_path):
    broken, state = {"patch": np.nan}, {"average": {"params": {"E": jnp.ones(2)}}}
    assert "no checkpoint was written yet" in line(tmp_path, broken)
    for step, kept in ((4, "step 4"), (6, "step 6 and the better one of step 4")):
        checkpoint.save(tmp_path / "run", step, state, {"best_step": 4, "history": []})
        assert f"the checkpoint of {kept} is kept;" in line(tmp_path, broken)
