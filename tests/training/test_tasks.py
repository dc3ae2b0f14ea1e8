"""The losses that read a pose off the unsheared image."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.networks import UNet
from jaxunshear.config.targets import count_outputs
from jaxunshear.errors import UserError
from jaxunshear.models import distances, posenet
from jaxunshear.models.registry import unshear
from jaxunshear.training.tasks import Supervision, make_unshear_task
from tests.helpers.network_parts import find_taught_parts
from tests.training import small

PLAIN = small.TRAINING.losses
BY_TAP = replace(small.TRAINING, losses={**PLAIN, "pose_tap": 0.5})
BY_LABEL = replace(small.TRAINING, losses={**PLAIN, "pose_label": 0.5})
UNET = UNet(small.SIZE, small.NET.widths)
# of x, yaw, edge distance and both outputs of the edge's direction
WEIGHTS = (1.0, 1.0, 4.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def teacher():
    outputs = count_outputs(small.TARGETS)
    fresh = jax.jit(lambda key: posenet.init(small.POSENET, outputs, key))(jax.random.key(9))
    # fresh ones answer 0.5 whatever they see
    wide = jax.tree.map(lambda leaf: 20 * leaf if leaf.ndim > 1 else leaf, fresh["params"])
    return partial(posenet.predict, small.POSENET, fresh | {"params": wide})


def make_task(teacher, net=small.NET, training=BY_TAP):
    """Return a task, its variables, and its terms as a function of a batch."""
    task = make_unshear_task(net, training, Supervision(small.TARGETS, teacher=teacher))
    variables = jax.jit(task.init)(jax.random.key(0))
    terms = jax.jit(lambda batch: task.terms(variables, batch, jax.random.key(2))[0])
    return task, variables, terms


def scale(images):
    return jnp.asarray(images, jnp.float32) / 255


def with_poses(batch):
    poses = jax.random.uniform(jax.random.key(8), (len(batch["sheared"]), 6), minval=-1.0)
    pose, edge = poses[:, :4] * np.array([5, 5, 45, 1]), poses[:, 4:] * np.array([5, 180])
    return batch | {"pose": pose, "edge": edge}


@pytest.mark.parametrize("net", [small.NET, UNET], ids=["unshear", "unet"])
def test_the_term_is_the_distance_of_what_the_teacher_reads(teacher, net):
    task, variables, _ = make_task(teacher, net)
    batch, read = small.pair(3, 4), jax.jit(teacher)
    image = jax.jit(unshear, static_argnums=0)(net, variables, scale(batch["sheared"]))
    expected = distances.compute_pose_loss(read(image), read(scale(batch["canonical"])), WEIGHTS)
    assert float(expected.min()) > 0
    named = jax.jit(task.validate)(variables, batch)
    np.testing.assert_allclose(named["pose_tap"], expected, rtol=1e-5)
    assert task.weights["pose_tap"] == 0.5


def test_its_gradient_reaches_what_makes_the_image_and_nothing_else(teacher):
    task, variables, _ = make_task(teacher)

    def compute_term(variables):
        return task.terms(variables, small.pair(3, 4), jax.random.key(2))[0]["pose_tap"]

    assert find_taught_parts(compute_term, variables) == {"E", "pose", "DC"}


def test_without_weight_the_teacher_is_never_asked():
    teacher = partial(pytest.fail, "asked")
    task = make_unshear_task(small.NET, small.TRAINING, Supervision(teacher=teacher))
    variables = jax.jit(task.init)(jax.random.key(0))
    terms, _ = jax.eval_shape(task.terms, variables, small.pair(3, 4), jax.random.key(2))
    assert set(terms) == set(PLAIN)
    validated = jax.eval_shape(task.validate, variables, small.pair(3, 4))
    assert set(validated) == {"supervised", "reconstruction"}


def test_against_labels_the_tap_does_not_enter(teacher):
    task, variables, compute_terms = make_task(teacher, training=BY_LABEL)
    batch = with_poses(small.pair(3, 4))
    image = jax.jit(unshear, static_argnums=0)(small.NET, variables, scale(batch["sheared"]))
    targets = posenet.scale_poses(batch, small.TARGETS)
    expected = distances.compute_pose_loss(jax.jit(teacher)(image), targets, WEIGHTS)
    named = jax.jit(task.validate)(variables, batch)
    np.testing.assert_allclose(named["pose_label"], expected, rtol=1e-5)
    trained = compute_terms(batch)
    other = compute_terms(batch | {"canonical": batch["canonical"][::-1]})
    np.testing.assert_array_equal(trained["pose_label"], other["pose_label"])
    assert np.all(trained["supervised"] != other["supervised"])
    moved = compute_terms(batch | {"pose": batch["pose"] + np.array([1, 0, 0, 0])})
    assert np.all(moved["pose_label"] != trained["pose_label"])


@pytest.mark.parametrize("training", [BY_TAP, BY_LABEL], ids=["tap", "label"])
def test_a_weight_takes_a_teacher_and_targets(teacher, training):
    with pytest.raises(UserError, match="a PoseNet is needed"):
        make_unshear_task(small.NET, training)
    with pytest.raises(UserError, match="no pose targets are known"):
        make_unshear_task(small.NET, training, Supervision(teacher=teacher))


def test_exchanged_codes_are_taught_if_partners_are_given():
    net, batch = replace(small.NET, separate_encoders=True), small.pair(3, 4)
    weights = {"counterfactual": 2.0, "code_agreement": 0.5}

    def make(**weights):
        """Return a task and its terms as a function of a batch."""
        task = make_unshear_task(net, replace(small.TRAINING, losses=PLAIN | weights))
        return task, jax.jit(lambda batch: task.terms(variables, batch, jax.random.key(2))[0])

    variables = jax.jit(make()[0].init)(jax.random.key(0))
    task, compute_terms = make(**weights)
    assert {name: task.weights[name] for name in weights} == weights
    same = batch | {"other": batch["sheared"], "swapped": batch["sheared"]}
    named = compute_terms(same)
    assert set(named) == {*PLAIN, *weights}
    assert all(value.shape == (4,) for value in named.values())
    np.testing.assert_allclose(named["counterfactual"], named["reconstruction"], rtol=1e-6)
    apart = same | {"swapped": batch["canonical"]}
    other = compute_terms(apart)["code_agreement"]
    assert np.all(named["code_agreement"] < 1e-6 * other)
    # without partners the codes of a slide and of its tap agree
    alone = compute_terms(batch)
    assert set(alone) == {*PLAIN, "code_agreement"}
    np.testing.assert_allclose(alone["code_agreement"], other, rtol=1e-4)
    for loss, weight in weights.items():  # nothing is drawn that has no weight
        assert set(make(**{loss: weight})[1](apart)) == {*PLAIN, loss}
