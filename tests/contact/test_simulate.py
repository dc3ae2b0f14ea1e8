"""Scenes through the dome of a real sensor: grouping, padding, refusals, and what a contact must look like."""

import numpy as np
import pytest

from jaxunshear.contact import simulate as module
from jaxunshear.contact.dome import deepest_mm
from jaxunshear.contact.obstacle import distance_at, sample
from jaxunshear.contact.simulate import BATCH, plan, simulate
from jaxunshear.errors import UserError
from jaxunshear.scene.scene import Scenes, draw_moves, draw_poses, make_scenes
from jaxunshear.scene.sensor import TACTIP_331, pin_tips
from jaxunshear.scene.stimuli import STIMULI, TRAINING, signed_distance

REST = pin_tips(TACTIP_331)


def scenes(count=12, depth=(1.0, 3.0), seed=0, slide=True):
    generator = np.random.default_rng(seed)
    pose = draw_poses(generator, count, 5.0, 45.0, depth)
    move = draw_moves(generator, count, 2.5) * slide
    return make_scenes(TRAINING, generator.integers(0, 3, count), pose, move)


def one(depth, x=0.0, move=(0.0, 0.0), yaw=0.0, friction=0.3, y=0.0):
    return Scenes(np.zeros(1, int), np.array([[x, y, yaw, depth]]), np.array([move], float), np.array([friction]))


@pytest.fixture(scope="module")
def contacts():
    return simulate(TACTIP_331, TRAINING, scenes())


def test_contacts_say_how_good_they_are(contacts):
    assert contacts.converged.all() and contacts.pins.shape == (12, 331, 3)
    assert np.all(contacts.residual_mm > 0) and np.all(contacts.iterations > 0)
    assert np.all(contacts.stuck + contacts.slipping > 0)
    assert np.all(contacts.force_n[:, 2] > 0)


def test_order_and_company_do_not_matter(contacts):
    order = np.random.default_rng(1).permutation(12)
    shuffled = simulate(TACTIP_331, TRAINING, scenes().take(order))
    np.testing.assert_array_equal(shuffled.pins, contacts.pins[order])
    alone = simulate(TACTIP_331, TRAINING, scenes().take(np.array([3])))
    # the batch stops together, so company may only make an answer more exact: 2e-3 mm is 0.01 px at 128
    np.testing.assert_allclose(alone.pins[0], contacts.pins[3], atol=3e-2)


def test_default_agrees_with_reference(contacts):
    reference = simulate(TACTIP_331, TRAINING, scenes(), level="reference")
    error = np.sqrt(np.mean(np.sum((contacts.pins - reference.pins) ** 2, -1), -1))
    assert np.percentile(error, 95) < 0.06  # mm: 0.2 px at 128


def test_no_contact_leaves_the_pins_exactly_where_they_are():
    above = simulate(TACTIP_331, ("disk",), one(-0.5))
    beside = simulate(TACTIP_331, ("disk",), one(1.0, x=15.0))
    for made in (above, beside):
        np.testing.assert_array_equal(made.pins[0], REST.astype(np.float32))
        assert not np.any(made.force_n) and made.converged.all()


def test_a_tap_on_a_flat_is_symmetric_and_pushes_up():
    made = simulate(TACTIP_331, ("disk",), one(2.0, x=-25.0))
    lift = (made.pins[0] - REST)[:, 2]
    assert lift[0] > 1.0
    ring = lift[1:7]
    np.testing.assert_allclose(ring, ring.mean(), atol=1e-3)
    assert np.abs(made.force_n[0, :2]).max() < 1e-3 * made.force_n[0, 2]


def test_a_slide_drags_the_skin_behind_it_and_friction_bounds_the_force():
    made = simulate(TACTIP_331, ("disk",), one(2.0, x=-15.0, move=(2.5, 0.0)))
    assert (made.pins[0] - REST)[0, 0] < -0.3
    pull = np.hypot(*made.force_n[0, :2])
    assert pull == pytest.approx(0.3 * made.force_n[0, 2], rel=0.01)  # full slip after 2.5 mm at this depth
    assert made.stuck[0] == 0


def test_turning_the_scene_turns_the_answer():
    straight = simulate(TACTIP_331, ("disk",), one(2.0, x=-25.0, move=(1.5, 0.0)))
    yaw = np.radians(60)
    turned = simulate(TACTIP_331, ("disk",), one(2.0, x=-25.0, move=(1.5, 0.0), yaw=-60.0))
    rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    rotated = straight.pins[0, :, :2] @ rotation.T
    nearest = np.linalg.norm(rotated[:, None] - turned.pins[0, None, :, :2], axis=-1).min(1)
    assert nearest.max() < 5e-3


def test_plan_takes_every_scene_once_and_keeps_needs_apart():
    mixed = scenes(200, (1.0, 6.0), seed=2)
    mixed.move[::3] = 0
    batches = plan(TACTIP_331, mixed)
    np.testing.assert_array_equal(np.sort(np.concatenate(batches)), np.arange(200))
    for index in batches:
        assert len(index) <= BATCH
        assert len(np.unique(module.rings_needed(TACTIP_331, mixed.pose[index, 3]))) == 1
        assert len(np.unique(np.any(mixed.move[index] != 0, axis=-1))) == 1


def test_leaving_out_of_reach_nodes_changes_nothing(monkeypatch):
    near = simulate(TACTIP_331, TRAINING, scenes(6, (2.0, 2.3)))
    monkeypatch.setattr(module, "RING_COUNTS", (16,))
    whole = simulate(TACTIP_331, TRAINING, scenes(6, (2.0, 2.3)))
    error = np.sqrt(np.mean(np.sum((near.pins - whole.pins) ** 2, -1), -1))
    assert error.max() < 0.02  # mm


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("pose", np.nan, "pose"),
        ("move", np.inf, "move"),
        ("friction", -0.1, "friction"),
        ("depth", 99.0, "cannot be reached"),
    ],
)
def test_bad_scenes_are_refused_by_name(field, value, message):
    bad = one(2.0)
    if field == "depth":
        bad.pose[0, 3] = value
    else:
        getattr(bad, field)[0] = value
    with pytest.raises(UserError, match=message):
        simulate(TACTIP_331, ("disk",), bad)
    with pytest.raises(UserError, match="level"):
        simulate(TACTIP_331, ("disk",), one(1.0), level="nonsense")


def test_the_deepest_pose_of_the_paper_is_covered():
    assert deepest_mm(TACTIP_331) > 6.0


def test_sampled_obstacles_agree_with_the_shapes():
    import jax.numpy as jnp

    points = np.random.default_rng(0).uniform(-15, 15, (1, 500, 2))
    obstacles = sample(tuple(STIMULI))
    for index, stimulus in enumerate(STIMULI.values()):
        exact = np.asarray(signed_distance(stimulus, jnp.asarray(points, jnp.float32)))
        sampled = np.asarray(distance_at(obstacles, jnp.asarray([index]), jnp.asarray(points, jnp.float32)))
        near = np.abs(exact) < 5
        assert np.percentile(np.abs(sampled - exact)[near], 95) < 0.01, stimulus.name
