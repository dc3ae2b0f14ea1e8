"""Losses of networks over pins: what each one teaches, and what counts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PinPoseNet, PinRenderer, PinUnshear
from jaxunshear.config.targets import make_label_targets, make_slide_targets
from jaxunshear.config.training import POSENET_TRAINING, Training
from jaxunshear.data.reader import OTHER, SWAPPED
from jaxunshear.models.distances import compute_pin_distance
from jaxunshear.models.pin_networks import encode, predict, unshear
from jaxunshear.models.registry import InitFacts
from jaxunshear.training.examples import ANOTHER, ONE, TAPS
from jaxunshear.training.tasks import (
    PinAugmentation,
    Supervision,
    make_posenet_task,
    make_renderer_task,
    make_unshear_task,
)
from tests.helpers.gradients import list_taught_parts

SMALL = {"hidden": 8, "layers": 1, "pose_code": 3, "shear_code": 2, "noise_px": 0.0}
RNG = np.random.default_rng(0)
REST = RNG.uniform(10, 100, (19, 2)).astype(np.float32)
POSES = np.zeros((6, 6), np.float32)
POSES[:, 1], POSES[:, 5] = np.linspace(-3, 3, 6), np.linspace(-170, 170, 6)
TARGETS = make_label_targets((), POSES)
KEY = jax.random.key(0)
FACTS = InitFacts(rest=REST, spread=1.0)


def name_losses(**losses):
    return Training(losses={"supervised": 1.0, "reconstruction": 1.0, **losses})


PAIRS = name_losses()


def batch(seed=0):
    rng = np.random.default_rng(seed)
    moved = {
        name: (REST + rng.normal(0, 1, (6, 19, 2))).astype(np.float32)
        for name in ("canonical_pins", "sheared_pins")
    }
    return moved | {"pins": moved["sheared_pins"], "pose": POSES}


def teacher(pins):
    return jax.nn.sigmoid(pins[:, :3, 0] - 50)


def test_every_part_is_taught_by_its_own_losses():
    task = make_unshear_task(PinUnshear(**SMALL), PAIRS, facts=FACTS)
    variables = task.init(KEY)

    def reached(term):
        def loss(params):
            return task.terms(variables | {"params": params}, batch(), KEY)[0][term].sum()

        return list_taught_parts(jax.jit(jax.grad(loss))(variables["params"]))

    assert reached("supervised") == {"E", "pose", "DC"}
    assert reached("reconstruction") == {"E", "pose", "shear", "DS"}


def test_taps_without_a_slide_come_out_as_they_went_in():
    net = PinUnshear(**SMALL)
    task = make_unshear_task(net, name_losses(tap_identity=0.5), facts=FACTS)
    variables, taps = task.init(KEY), batch(3)["canonical_pins"][:2]
    assert task.weights["tap_identity"] == 0.5
    assert "tap_identity" not in task.validate(variables, batch())

    def term(params, name="tap_identity"):
        return task.terms(variables | {"params": params}, batch() | {TAPS: taps}, KEY)[0][name]

    np.testing.assert_allclose(
        term(variables["params"]),
        compute_pin_distance(unshear(net, variables, taps), taps, variables),
        rtol=1e-5,
    )
    slopes = jax.jit(jax.grad(lambda params: term(params).sum()))(variables["params"])
    assert list_taught_parts(slopes) == {"E", "pose", "DC"}  # no slide is asked of a tap
    plain = make_unshear_task(net, PAIRS, facts=FACTS).terms(variables, batch(), KEY)[0]
    np.testing.assert_array_equal(term(variables["params"], "supervised"), plain["supervised"])


def test_two_slides_to_one_pose_are_unsheared_alike():
    net = PinUnshear(**SMALL)
    task = make_unshear_task(net, name_losses(consistency=2.0), facts=FACTS)
    variables = task.init(KEY)
    pins = batch(3)["sheared_pins"][:2]
    other = batch(4)["sheared_pins"][:2]
    named = task.terms(variables, batch() | {ONE: pins, ANOTHER: other}, KEY)[0]
    wanted = compute_pin_distance(
        unshear(net, variables, pins), unshear(net, variables, other), variables
    )
    np.testing.assert_allclose(named["consistency"], wanted, rtol=1e-5)
    assert task.weights["consistency"] == 2.0 and np.all(named["consistency"] > 0)
    same = task.terms(variables, batch() | {ONE: pins, ANOTHER: pins}, KEY)[0]
    assert np.all(same["consistency"] == 0)
    assert "consistency" not in task.validate(variables, batch())


def test_rendered_taps_teach_at_the_poses_they_were_rendered_at():
    """With a renderer that PoseNet inverts nothing is left to learn of its taps, and without one they are no term."""
    net = PinPoseNet(**SMALL)
    plain = make_posenet_task(net, POSENET_TRAINING, TARGETS, FACTS)
    variables = plain.init(KEY)
    assert set(plain.terms(variables, batch(), KEY)[0]) == {"pose"}
    seen = []

    def render(outputs):
        seen.append(outputs)
        return REST + jnp.zeros((len(outputs), 1, 1)).at[:, 0, 0].set(outputs[:, 0])[..., :1]

    training = Training(losses={"pose": 1.0, "rendered_pose": 1.0})
    task = make_posenet_task(net, training, TARGETS, FACTS, PinAugmentation(render=render))
    named = task.terms(variables, batch(), KEY)[0]
    read = predict(net, variables, render(seen[0]))
    np.testing.assert_allclose(
        named["rendered_pose"], jnp.abs(read - seen[0]).sum(-1) / seen[0].shape[1], rtol=1e-5
    )
    np.testing.assert_array_equal(named["pose"], plain.terms(variables, batch(), KEY)[0]["pose"])
    other = task.terms(variables, batch(), jax.random.key(1))[0]["rendered_pose"]
    assert np.any(np.asarray(other) != np.asarray(named["rendered_pose"]))


@pytest.mark.parametrize("loss", ["pose_tap", "pose_label"])
def test_a_teacher_asks_for_the_true_pose_or_the_partners(loss):
    training, supervision = name_losses(**{loss: 1.0}), Supervision(TARGETS, teacher=teacher)
    task = make_unshear_task(PinUnshear(**SMALL), training, supervision, FACTS)
    variables, given = task.init(KEY), batch()
    first = task.validate(variables, given)[loss]
    moved = given | {"canonical_pins": given["canonical_pins"] + 3}
    other = task.validate(variables, moved)[loss]
    turned = task.validate(variables, given | {"pose": POSES[::-1]})[loss]
    assert np.any(other != first) == (loss == "pose_tap")
    assert np.any(turned != first) == (loss == "pose_label")


def test_what_has_no_weight_or_no_sure_pins_teaches_nothing():
    task = make_unshear_task(PinUnshear(**SMALL), PAIRS, facts=FACTS)
    variables = task.init(KEY)
    sure = np.array([1, 0, 1, 1, 0, 1])
    weight = np.float32([2, 2, 1, 0, 1, 1])
    plain, weighed = (
        task.terms(variables, batch() | more, KEY)[0]["supervised"]
        for more in ({}, {"sure": sure, "weight": weight})
    )
    np.testing.assert_allclose(weighed, plain * sure * weight, rtol=1e-6)


def test_a_renderer_and_a_posenet_learn_a_linear_skin():
    """Pins that move in proportion to y: both find it in a few hundred steps."""
    import optax

    direction = RNG.normal(0, 1, (19, 2)).astype(np.float32)
    poses = np.zeros((64, 6), np.float32)
    poses[:, 1] = np.linspace(-3, 3, 64)
    given = {"pins": REST + poses[:, 1, None, None] / 3 * direction, "pose": poses}
    targets = make_label_targets((), poses)
    for kind, make, name in (
        (PinRenderer, make_renderer_task, "pins"),
        (PinPoseNet, make_posenet_task, "pose"),
    ):
        training = Training(losses={name: 1.0})
        task = make(kind(**SMALL | {"hidden": 32}), training, targets, FACTS)
        variables = task.init(KEY)
        optimiser = optax.adam(1e-2)

        @jax.jit
        def step(params, state, task=task, variables=variables, optimiser=optimiser):
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
    slides = make_slide_targets(Ranges(move_mm=2.0, twist_deg=5.0))
    net = PinUnshear(**SMALL | {"shear_code": 4}, apart=True)
    task = make_unshear_task(net, name_losses(slide=3.0), Supervision(slides=slides), FACTS)
    variables, given = task.init(KEY), batch()
    z_s = np.asarray(encode(net, variables, given["sheared_pins"])[1])
    given["felt"] = z_s[:, :3] * np.array([2.0, 2.0, 5.0], np.float32)
    assert task.weights["slide"] == 3.0
    np.testing.assert_allclose(task.validate(variables, given)["slide"], 0, atol=1e-12)
    given["felt"] = given["felt"] + np.array([2.0, 0.0, 0.0], np.float32)  # by half of its range
    np.testing.assert_allclose(task.validate(variables, given)["slide"], 1 / 3, rtol=1e-5)

    def slide(params, given):
        return task.validate(variables | {"params": params}, given)["slide"].sum()

    slope = jax.grad(slide)(variables["params"], given)
    assert list_taught_parts(slope) == {"ES", "shear"}
    assert not np.any(slope["shear"]["kernel"][:, 3])  # a fourth number is free
    unknown = given | {"felt": np.full_like(given["felt"], np.nan)}
    assert not list_taught_parts(jax.grad(slide)(variables["params"], unknown))


def test_exchanged_codes_are_taught_where_partners_are_given():
    training = name_losses(counterfactual=2.0, code_agreement=0.5)
    task = make_unshear_task(PinUnshear(**SMALL, apart=True), training, facts=FACTS)
    variables, given = task.init(KEY), batch()
    partners = {OTHER: batch(1)["sheared_pins"], SWAPPED: batch(2)["sheared_pins"]}
    # without partners a slide's pose code is to agree with its tap's
    assert set(task.terms(variables, given, KEY)[0]) == {
        "supervised",
        "reconstruction",
        "code_agreement",
    }
    tap = task.validate(variables, given | {"sheared_pins": given["canonical_pins"]})
    assert np.all(tap["code_agreement"] == 0)
    terms = task.terms(variables, given | partners, KEY)[0]
    assert set(terms) == {"supervised", "reconstruction", "counterfactual", "code_agreement"}
    assert all(value.shape == (6,) for value in terms.values())
    assert (task.weights["counterfactual"], task.weights["code_agreement"]) == (2.0, 0.5)
    still = task.validate(variables, given | partners)
    np.testing.assert_array_equal(
        still["counterfactual"], task.validate(variables, given | partners)["counterfactual"]
    )
    assert np.all(still["code_agreement"] > 0)
    same = {OTHER: given["sheared_pins"], SWAPPED: given["sheared_pins"]}
    alike = task.validate(variables, given | same)
    np.testing.assert_allclose(alike["counterfactual"], alike["reconstruction"], rtol=1e-5)
    assert np.all(alike["code_agreement"] == 0)
    for loss in ("code_agreement", "counterfactual"):  # nothing is drawn that has no weight
        net, training = PinUnshear(**SMALL, apart=True), name_losses(**{loss: 0.5})
        alone = make_unshear_task(net, training, facts=FACTS)
        terms = alone.terms(variables, given | partners, KEY)[0]
        assert set(terms) == {"supervised", "reconstruction", loss}
