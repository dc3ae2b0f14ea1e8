"""Training that goes on from weights there are."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.errors import UserError
from jaxunshear.model import unshearnet
from jaxunshear.training import checkpoint, loop
from jaxunshear.training.start import Start, started
from jaxunshear.training.tasks import unshear_task

sys.path.insert(0, str(Path(__file__).parent))
import small


def tree(value, **shapes):
    return {"params": {name: {"kernel": jnp.full(shape, value)} for name, shape in shapes.items()}}


def test_what_both_have_is_taken_and_nothing_else():
    found = started(tree(0.0, E=(2, 3), DS=(4,)), tree(1.0, E=(2, 3), other=(5,)))
    assert jax.tree.map(np.shape, found) == jax.tree.map(np.shape, tree(0.0, E=(2, 3), DS=(4,)))
    assert float(found["params"]["E"]["kernel"].min()) == 1 and float(found["params"]["DS"]["kernel"].max()) == 0


@pytest.mark.parametrize(
    ("start", "line"),
    [
        (tree(1.0, E=(3, 2)), r"params.E.kernel is \(3, 2\) there and \(2, 3\) here"),
        (
            {"params": {"E": {"kernel": jnp.ones((2, 3)), "Same_0": jnp.ones(3)}}},
            r"params.E.Same_0 is there and has no place",
        ),
        (tree(1.0, other=(2, 3)), "nothing in common"),
        ({}, "nothing in common"),
    ],
)
def test_weights_that_do_not_fit_are_refused(start, line):
    with pytest.raises(UserError, match=line):
        started(tree(0.0, E=(2, 3)), start)


def trained(folder, start):
    """One step so short that weights stay where they begin."""
    training = replace(small.TRAINING, epochs=0.25, learning_rate=1e-12, averaging=0.0, l1=0.0, l2=0.0)
    return loop.train(
        unshear_task(small.NET, training),
        training,
        lambda first: small.endless(small.pair, first),
        lambda: iter([small.pair(1000, 4)]),
        0,
        folder,
        epoch_images=small.IMAGES,
        start=start,
    )


@pytest.mark.long
def test_a_training_goes_on_from_released_weights_and_knows_which(tmp_path):
    """Those hold E, the pose code and DC: the rest is as fresh as without them."""
    there = unshearnet.init(small.NET, jax.random.key(5))
    released = {kind: {m: v for m, v in parts.items() if m not in ("shear", "DS")} for kind, parts in there.items()}
    trained(tmp_path / "started", Start(released, "of these"))
    trained(tmp_path / "fresh", None)
    found, fresh = (checkpoint.load_best(tmp_path / name)["params"] for name in ("started", "fresh"))
    for module in ("E", "pose", "DC"):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), found[module], there["params"][module])
    for module in ("shear", "DS"):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), found[module], fresh[module])
    assert not np.allclose(found["E"]["First_0"]["kernel"], fresh["E"]["First_0"]["kernel"])
    assert json.loads((tmp_path / "started" / "model.json").read_text())["start"] == "of these"
    assert "start" not in json.loads((tmp_path / "fresh" / "model.json").read_text())
    with pytest.raises(UserError, match="start = of these, now others"):
        trained(tmp_path / "started", Start(released, "others"))
