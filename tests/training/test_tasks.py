"""The losses that read a pose off the unsheared image."""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import UNet
from jaxunshear.config.targets import make_slide_targets
from jaxunshear.errors import UserError
from jaxunshear.models import distances, posenet, unshearnet
from jaxunshear.models.registry import unshear
from jaxunshear.training.tasks import Supervision, make_unshear_task

sys.path.insert(0, str(Path(__file__).parent))
import small

PLAIN = small.TRAINING.losses
BY_TAP = replace(small.TRAINING, losses={**PLAIN, "pose_tap": 0.5})
BY_LABEL = replace(small.TRAINING, losses={**PLAIN, "pose_label": 0.5})
UNET = UNet(small.SIZE, small.NET.widths)
WEIGHTS = (
    1.0,
    1.0,
    4.0,
    1.0,
    1.0,
)  # of x, yaw, edge distance and both outputs of the edge's direction


@pytest.fixture(scope="module")
def teacher():
    outputs = posenet.count_outputs(small.TARGETS)
    fresh = jax.jit(lambda key: posenet.init(small.POSENET, outputs, key))(jax.random.key(9))
    # fresh ones answer 0.5 whatever they see
    wide = jax.tree.map(lambda leaf: 20 * leaf if leaf.ndim > 1 else leaf, fresh["params"])
    return partial(posenet.predict, small.POSENET, fresh | {"params": wide})


def gradient_of(task, variables, batch, name):
    def term(params):
        named, _ = task.terms(variables | {"params": params}, batch, jax.random.key(2))
        return jnp.sum(named[name])

    return jax.jit(jax.grad(term))(variables["params"])


def with_poses(batch):
    poses = jax.random.uniform(jax.random.key(8), (len(batch["sheared"]), 6), minval=-1.0)
    return batch | {
        "pose": poses[:, :4] * np.array([5, 5, 45, 1]),
        "edge": poses[:, 4:] * np.array([5, 180]),
    }


@pytest.mark.parametrize("net", [small.NET, UNET], ids=["unshear", "unet"])
def test_the_term_is_the_distance_of_what_the_teacher_reads(teacher, net):
    task = make_unshear_task(net, BY_TAP, Supervision(small.TARGETS, teacher=teacher))
    variables, batch = jax.jit(task.init)(jax.random.key(0)), small.pair(3, 4)
    canonical, sheared = (
        jnp.asarray(batch[name], jnp.float32) / 255 for name in ("canonical", "sheared")
    )
    named = jax.jit(task.validate)(variables, batch)
    image, read = jax.jit(unshear, static_argnums=0)(net, variables, sheared), jax.jit(teacher)
    expected = distances.compute_pose_loss(read(image), read(canonical), WEIGHTS)
    assert float(expected.min()) > 0
    np.testing.assert_allclose(named["pose_tap"], expected, rtol=1e-5)
    assert task.weights["pose_tap"] == 0.5


def test_its_gradient_reaches_what_makes_the_image_and_nothing_else(teacher):
    task = make_unshear_task(small.NET, BY_TAP, Supervision(small.TARGETS, teacher=teacher))
    batch = small.pair(3, 4)
    gradient = gradient_of(task, jax.jit(task.init)(jax.random.key(0)), batch, "pose_tap")
    largest = {
        name: max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(part))
        for name, part in gradient.items()
    }
    assert all(largest[name] > 0 for name in ("E", "pose", "DC"))
    assert all(largest[name] == 0 for name in ("shear", "DS"))


def test_without_weight_the_teacher_is_never_asked():
    def asked(images):
        raise AssertionError("asked")

    task = make_unshear_task(small.NET, small.TRAINING, Supervision(teacher=asked))
    variables = jax.jit(task.init)(jax.random.key(0))
    terms, _ = jax.eval_shape(task.terms, variables, small.pair(3, 4), jax.random.key(2))
    assert set(terms) == set(PLAIN)
    validated = jax.eval_shape(task.validate, variables, small.pair(3, 4))
    assert set(validated) == {"supervised", "reconstruction"}


def test_against_labels_it_is_the_distance_of_the_true_pose(teacher):
    net = small.NET
    task = make_unshear_task(net, BY_LABEL, Supervision(small.TARGETS, teacher=teacher))
    batch = with_poses(small.pair(3, 4))
    variables = jax.jit(task.init)(jax.random.key(0))
    image = jax.jit(unshear, static_argnums=0)(
        net, variables, jnp.asarray(batch["sheared"], jnp.float32) / 255
    )
    targets = posenet.scale_poses(batch, small.TARGETS)
    expected = distances.compute_pose_loss(jax.jit(teacher)(image), targets, WEIGHTS)
    np.testing.assert_allclose(
        jax.jit(task.validate)(variables, batch)["pose_label"], expected, rtol=1e-5
    )


@pytest.mark.parametrize("training", [BY_TAP, BY_LABEL], ids=["tap", "label"])
def test_a_weight_takes_a_teacher_and_targets(teacher, training):
    with pytest.raises(UserError, match="a PoseNet is needed"):
        make_unshear_task(small.NET, training)
    with pytest.raises(UserError, match="no pose targets are known"):
        make_unshear_task(small.NET, training, Supervision(teacher=teacher))


def test_codes_that_are_apart_learn_from_partners_and_from_the_slide():
    net = replace(small.NET, apart=True)
    slides = make_slide_targets(Ranges(move_mm=2.0))
    losses = {**PLAIN, "counterfactual": 2.0, "code_agreement": 0.5, "slide": 3.0}
    task = make_unshear_task(
        net, replace(small.TRAINING, losses=losses), Supervision(slides=slides)
    )
    variables, given = jax.jit(task.init)(jax.random.key(0)), small.pair(3, 4)
    same = given | {
        "other": given["sheared"],
        "swapped": given["sheared"],
        "felt": np.zeros((4, 2), np.float32),
    }
    terms = jax.jit(lambda batch: task.terms(variables, batch, jax.random.key(2))[0])
    named = terms(same)
    assert set(named) == set(losses)
    assert all(value.shape == (4,) for value in named.values())
    np.testing.assert_allclose(named["counterfactual"], named["reconstruction"], rtol=1e-6)
    other = terms(same | {"swapped": given["canonical"]})["code_agreement"]
    assert np.all(named["code_agreement"] < 1e-6 * other)
    # where poses share no slides, the codes of a slide and of its tap agree
    tap = replace(small.TRAINING, losses={**losses, "counterfactual": 0.0})
    alone = make_unshear_task(net, tap, Supervision(slides=slides)).terms(
        variables, given | {"felt": same["felt"]}, jax.random.key(2)
    )[0]
    assert "counterfactual" not in alone
    np.testing.assert_allclose(
        alone["code_agreement"],
        terms(same | {"swapped": given["canonical"]})["code_agreement"],
        rtol=1e-4,
    )
    assert [task.weights[name] for name in ("counterfactual", "code_agreement", "slide")] == [
        2.0,
        0.5,
        3.0,
    ]
    z_s = np.asarray(
        unshearnet.encode(net, variables, jnp.asarray(given["sheared"], jnp.float32) / 255)[1]
    )
    known = task.validate(variables, given | {"felt": 2 * z_s[:, 0, 0, :2]})
    np.testing.assert_allclose(known["slide"], 0, atol=1e-10)
