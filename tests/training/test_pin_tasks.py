"""Losses of networks over pins: what each one teaches, and what counts."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PinPoseNet, PinRenderer, PinUnshear
from jaxunshear.config.targets import count_outputs, make_label_targets, make_slide_targets
from jaxunshear.config.training import POSENET_TRAINING, Training
from jaxunshear.models.distances import compute_pin_distance
from jaxunshear.models.pin_networks import encode, predict, unshear
from jaxunshear.models.registry import InitFacts
from jaxunshear.training.examples import ANOTHER, ONE, TAPS
from jaxunshear.training.tasks import (
    PinAugmentation,
    Supervision,
    give_tasks,
    make_posenet_task,
    make_renderer_task,
    make_unshear_task,
    rotate_pairs,
)
from tests.helpers.gradients import list_taught_parts
from tests.helpers.network_parts import find_taught_parts

SMALL = {"hidden": 8, "layers": 1, "pose_code": 3, "shear_code": 2, "noise_px": 0.0}
RNG = np.random.default_rng(0)
REST = RNG.uniform(10, 100, (19, 2)).astype(np.float32)
DIRECTION = RNG.normal(0, 1, (19, 2)).astype(np.float32)
POSES = np.zeros((6, 6), np.float32)
POSES[:, 1], POSES[:, 5] = np.linspace(-3, 3, 6), np.linspace(-170, 170, 6)
TARGETS = make_label_targets((), POSES)
KEY = jax.random.key(0)
FACTS = InitFacts(rest=REST, spread=1.0)


def name_losses(**losses):
    return Training(losses={"supervised": 1.0, "reconstruction": 1.0, **losses})


PAIRS = name_losses()


def make_task(training=PAIRS, supervision=Supervision(), **changes):
    """Return a network, its task and its variables."""
    net = PinUnshear(**SMALL | changes)
    task = make_unshear_task(net, training, supervision, FACTS)
    return net, task, task.init(KEY)


def batch(seed=0):
    rng = np.random.default_rng(seed)
    names = ("canonical_pins", "sheared_pins")
    moved = {name: np.float32(REST + rng.normal(0, 1, (6, 19, 2))) for name in names}
    return moved | {"pins": moved["sheared_pins"], "pose": POSES}


@pytest.mark.parametrize(
    ("term", "parts"),
    [("supervised", {"E", "pose", "DC"}), ("reconstruction", {"E", "pose", "shear", "DS"})],
)
def test_every_part_is_taught_by_its_own_losses(term, parts):
    _, task, variables = make_task()
    assert find_taught_parts(lambda v: task.terms(v, batch(), KEY)[0][term], variables) == parts


def test_taps_without_a_slide_come_out_as_they_went_in():
    net, task, variables = make_task(name_losses(tap_identity=0.5))
    taps = batch(3)["canonical_pins"][:2]
    assert task.weights["tap_identity"] == 0.5
    assert "tap_identity" not in task.validate(variables, batch())

    def compute_terms(variables):
        return task.terms(variables, batch() | {TAPS: taps}, KEY)[0]

    expected = compute_pin_distance(unshear(net, variables, taps), taps, variables)
    terms = compute_terms(variables)
    np.testing.assert_allclose(terms["tap_identity"], expected, rtol=1e-5)
    # no slide is asked of a tap
    taught = find_taught_parts(lambda v: compute_terms(v)["tap_identity"], variables)
    assert taught == {"E", "pose", "DC"}
    plain = make_task()[1].terms(variables, batch(), KEY)[0]
    np.testing.assert_array_equal(terms["supervised"], plain["supervised"])


def test_two_slides_to_one_pose_are_unsheared_alike():
    net, task, variables = make_task(name_losses(consistency=2.0))
    pins, other = (batch(seed)["sheared_pins"][:2] for seed in (3, 4))

    def compute_term(another):
        return task.terms(variables, batch() | {ONE: pins, ANOTHER: another}, KEY)[0]["consistency"]

    found, wanted = (unshear(net, variables, each) for each in (pins, other))
    expected = compute_pin_distance(found, wanted, variables)
    np.testing.assert_allclose(compute_term(other), expected, rtol=1e-5)
    assert task.weights["consistency"] == 2.0 and np.all(expected > 0)
    assert np.all(compute_term(pins) == 0)
    assert "consistency" not in task.validate(variables, batch())


@pytest.mark.parametrize("is_rotated", [True, False])
def test_rotated_pairs_teach_what_needs_no_label(is_rotated):
    def teach(pins):
        return jnp.tanh(pins.reshape(len(pins), -1)[:, : count_outputs(TARGETS)])

    def rotate(batch, key):
        return batch | {"sheared_pins": batch["sheared_pins"] + 1}, jnp.asarray(is_rotated)

    _, task, variables = make_task(name_losses(pose_label=2.0), Supervision(TARGETS, (), teach))
    rotated = rotate_pairs(task, rotate)
    moved, _ = rotate(batch(), KEY)
    expected, _ = task.terms(variables, moved, KEY)
    terms, _ = rotated.terms(variables, batch(), KEY)
    assert np.all(expected["pose_label"] > 0)
    for name, values in expected.items():
        is_unknown = is_rotated and name == "pose_label"
        np.testing.assert_array_equal(terms[name], 0 * values if is_unknown else values)
    # contacts for validation are as they were recorded
    for name, values in task.validate(variables, batch()).items():
        np.testing.assert_array_equal(rotated.validate(variables, batch())[name], values)


def test_rendered_taps_teach_at_the_poses_they_were_rendered_at():
    """With a renderer that PoseNet inverts nothing is left to learn of its taps, and without one they are no term."""
    net = PinPoseNet(**SMALL)
    plain = make_posenet_task(net, POSENET_TRAINING, TARGETS, FACTS)
    variables = plain.init(KEY)
    alone = plain.terms(variables, batch(), KEY)[0]
    assert set(alone) == {"pose"}
    seen = []

    def render(outputs):
        seen.append(outputs)
        return REST + jnp.zeros((len(outputs), 1, 1)).at[:, 0, 0].set(outputs[:, 0])[..., :1]

    training = Training(losses={"pose": 1.0, "rendered_pose": 1.0})
    task = make_posenet_task(net, training, TARGETS, FACTS, PinAugmentation(render=render))
    named = task.terms(variables, batch(), KEY)[0]
    off = jnp.abs(predict(net, variables, render(seen[0])) - seen[0])
    np.testing.assert_allclose(named["rendered_pose"], off.sum(-1) / off.shape[1], rtol=1e-5)
    np.testing.assert_array_equal(named["pose"], alone["pose"])
    other = task.terms(variables, batch(), jax.random.key(1))[0]
    assert np.any(other["rendered_pose"] != named["rendered_pose"])


def test_what_has_no_weight_or_no_sure_pins_teaches_nothing():
    _, task, variables = make_task()
    sure, weight = np.array([1, 0, 1, 1, 0, 1]), np.float32([2, 2, 1, 0, 1, 1])
    plain, weighed = (
        task.terms(variables, batch() | more, KEY)[0]["supervised"]
        for more in ({}, {"sure": sure, "weight": weight})
    )
    np.testing.assert_allclose(weighed, plain * sure * weight, rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "make", "name"),
    [(PinRenderer, make_renderer_task, "pins"), (PinPoseNet, make_posenet_task, "pose")],
)
def test_a_renderer_and_a_posenet_learn_a_linear_skin(kind, make, name):
    """Pins that move in proportion to y: both find it in a few hundred steps."""
    poses = np.zeros((64, 6), np.float32)
    poses[:, 1] = np.linspace(-3, 3, 64)
    given = {"pins": REST + poses[:, 1, None, None] / 3 * DIRECTION, "pose": poses}
    net, targets = kind(**SMALL | {"hidden": 32}), make_label_targets((), poses)
    task = make(net, Training(losses={name: 1.0}), targets, FACTS)
    variables, optimiser = task.init(KEY), optax.adam(1e-2)

    @jax.jit
    def step(params, state):
        def compute_loss(params):
            terms, _ = task.terms(variables | {"params": params}, given, KEY)
            return sum(jnp.mean(term) for term in terms.values())

        value, slope = jax.value_and_grad(compute_loss)(params)
        updates, state = optimiser.update(slope, state)
        return optax.apply_updates(params, updates), state, value

    params, state = variables["params"], optimiser.init(variables["params"])
    _, _, first = step(params, state)
    for _ in range(200):
        params, state, last = step(params, state)
    assert float(last) < 0.05 * float(first)


def test_the_first_numbers_of_the_shear_code_are_taught_the_slide():
    supervision = Supervision(slides=make_slide_targets(Ranges(move_mm=2.0, twist_deg=5.0)))
    training = name_losses(slide=3.0)
    net, task, variables = make_task(training, supervision, shear_code=4, separate_encoders=True)
    assert task.weights["slide"] == 3.0
    given = batch()
    z_s = np.asarray(encode(net, variables, given["sheared_pins"])[1])

    def compute_term(params, felt):
        return task.validate(variables | {"params": params}, given | {"felt": felt})["slide"]

    params, felt = variables["params"], z_s[:, :3] * np.array([2.0, 2.0, 5.0], np.float32)
    np.testing.assert_allclose(compute_term(params, felt), 0, atol=1e-12)
    felt = felt + np.array([2.0, 0.0, 0.0], np.float32)  # by half of its range
    np.testing.assert_allclose(compute_term(params, felt), 1 / 3, rtol=1e-5)
    differentiate = jax.grad(lambda params, felt: compute_term(params, felt).sum())
    slope = differentiate(params, felt)
    assert list_taught_parts(slope) == {"ES", "shear"}
    assert not np.any(slope["shear"]["kernel"][:, 3])  # a fourth number is free
    assert not list_taught_parts(differentiate(params, np.full_like(felt, np.nan)))


def test_exchanged_codes_are_compared_in_validation_too():
    _, task, variables = make_task(
        name_losses(counterfactual=2.0, code_agreement=0.5), separate_encoders=True
    )
    given = batch()
    tap = task.validate(variables, given | {"sheared_pins": given["canonical_pins"]})
    assert np.all(tap["code_agreement"] == 0)  # without partners it is that of a slide and its tap
    partners = {"other_pins": batch(1)["sheared_pins"], "swapped_pins": batch(2)["sheared_pins"]}
    still, again = (task.validate(variables, given | partners) for _ in range(2))
    np.testing.assert_array_equal(still["counterfactual"], again["counterfactual"])
    assert np.all(still["code_agreement"] > 0)
    alike = task.validate(variables, given | dict.fromkeys(partners, given["sheared_pins"]))
    np.testing.assert_allclose(alike["counterfactual"], alike["reconstruction"], rtol=1e-5)
    assert np.all(alike["code_agreement"] == 0)


@pytest.mark.parametrize("loss", ["pose_tap", "pose_label"])
def test_a_teacher_asks_for_the_true_pose_or_the_partners(loss):
    supervision = Supervision(TARGETS, teacher=lambda pins: jax.nn.sigmoid(pins[:, :3, 0] - 50))
    _, task, variables = make_task(name_losses(**{loss: 1.0}), supervision)
    given, other_taps = batch(), batch()["canonical_pins"] + 3
    first = task.validate(variables, given)[loss]
    other = task.validate(variables, given | {"canonical_pins": other_taps})[loss]
    turned = task.validate(variables, given | {"pose": POSES[::-1]})[loss]
    assert np.any(other != first) == (loss == "pose_tap")
    assert np.any(turned != first) == (loss == "pose_label")


@pytest.mark.parametrize("conv_channels", [(), (4, 6)])
def test_contacts_of_a_task_teach_its_own_weights_and_none_of_others(conv_channels):
    net = PinUnshear(**SMALL, conv_channels=conv_channels)
    facts = FACTS._replace(tasks=np.full(2, 0.5, np.float32))
    task = give_tasks(make_unshear_task(net, PAIRS, facts=facts), 2)
    variables = task.init(KEY)
    pairs = batch() | {"stimulus": np.ones(6, np.int32)}
    layer = "Conv_0" if conv_channels else "Dense_0"

    def compute_loss(params):
        terms, constants = task.terms(variables | {"params": params}, pairs, KEY)
        return terms["supervised"].sum(), constants

    gradient, constants = jax.grad(compute_loss, has_aux=True)(variables["params"])
    of_tasks = gradient["E"][layer]["kernel"][..., -2:, :]
    assert (of_tasks[..., 0, :] == 0).all() and np.abs(of_tasks[..., 1, :]).max() > 0
    np.testing.assert_array_equal(constants["tasks"], facts.tasks)
    first = task.validate(variables, pairs | {"stimulus": np.zeros(6, np.int32)})
    assert (first["supervised"] != task.validate(variables, pairs)["supervised"]).any()
