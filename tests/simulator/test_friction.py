"""The solver in float32; tests/verification/test_verify.py has closed forms and laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.simulator.contact_problem import (
    RHO,
    ContactProblem,
    Skin,
    System,
    count_node_states,
    make_undeformed_skins,
    project,
)
from jaxunshear.simulator.friction import BETWEEN_CHECKS, Solver, follow_path
from jaxunshear.simulator.paths import compute_level_frame
from jaxunshear.simulator.stimuli import Obstacles
from verification.half_space import make_press_poses, trace_forces
from verification.normal_contact import SPHERE_MM, compute_hertz_depth
from verification.tangential_contact import FRICTION, compute_slip_distance

FLAT = Obstacles(jnp.full((1, 5, 5), -10.0))
RADIUS_MM = 0.45
SHARES = np.array([0.0, 0.6, 1.5])  # of the slip distance
SOLVER = Solver(1e-3, 4000)


@pytest.fixture(scope="module")
def near(half_space):
    return np.flatnonzero(half_space.radius < 1.4 * RADIUS_MM)


@pytest.fixture(scope="module")
def system(half_space, near):
    rows = (3 * near[:, None] + np.arange(3)).ravel()
    w = half_space.w[np.ix_(rows, rows)]
    w = w / (np.trace(w) / len(w))
    nodes = np.column_stack([half_space.nodes[near, :2], half_space.sphere(SPHERE_MM)[near]])
    inverse = np.linalg.inv(w + RHO * np.eye(len(w)))
    return System(*(jnp.asarray(field, jnp.float32) for field in (w, inverse, w, nodes, 1.0, 1.0)))


@pytest.fixture(scope="module")
def slides(half_space):
    poses = make_press_poses(np.full(len(SHARES), compute_hertz_depth(RADIUS_MM)), 4)
    slip = compute_slip_distance(half_space, RADIUS_MM)
    poses[2:, :, 0] = np.linspace(0, 1, 5)[1:, None] * SHARES * slip
    return poses


def make_problem(system, count, friction=FRICTION, tilted=False):
    index, mu = jnp.zeros(count, jnp.int32), jnp.full(count, friction, jnp.float32)
    return ContactProblem(system, FLAT, index, mu, tilted)


def follow(system, poses, friction=FRICTION, solver=SOLVER):
    path = jnp.asarray(poses, jnp.float32)
    start = make_undeformed_skins(system, path[0])
    return follow_path(make_problem(system, path.shape[1], friction), path[1:], start, solver)


def test_float32_agrees_with_float64_on_forces_and_on_what_sticks(half_space, near, system, slides):
    skin, quality = follow(system, slides)
    assert np.all(quality.residual_mm <= quality.tolerance_mm)
    height = half_space.sphere(SPHERE_MM)
    trace = trace_forces(half_space, height, slides, FRICTION, within_mm=1.4 * RADIUS_MM)
    single, double = np.asarray(skin.force), trace.force[-1][:, near]
    single, double = (force / force[0, :, 2].sum() for force in (single, double))
    np.testing.assert_allclose(single.sum(1), double.sum(1), atol=5e-3)
    np.testing.assert_allclose(single, double, atol=1e-2)
    stuck, slipping, free = map(np.asarray, count_node_states(make_problem(system, 3), skin))
    np.testing.assert_array_equal(stuck + slipping + free, len(system.nodes))
    assert stuck[0] > 0.8 * (stuck[0] + slipping[0])  # pressed only
    assert 0 < stuck[1] < stuck[0]
    assert stuck[2] == 0 and slipping[2] > 0


@pytest.mark.parametrize("friction", [0.3, 1e-5, 1e-18, 1e-20, 1e-30, 1e-35, 1e-37])
def test_tiny_frictions_give_stuck_from_slipping(system, friction):
    rng = np.random.default_rng(0)
    force = np.concatenate([100 * rng.normal(size=(1, 99, 2)), rng.uniform(0.1, 2, (1, 99, 1))], -1)
    held = project(jnp.asarray(force, jnp.float32), jnp.full(1, friction, jnp.float32))

    def count(force, tilt):
        pose = jnp.zeros((1, 6)).at[:, 4].set(tilt)
        force = force @ compute_level_frame(pose)  # from the level frame to the sensor's
        problem = make_problem(system, 1, friction, tilted=bool(tilt))
        counts = count_node_states(problem, Skin(force, force, force, pose))
        return np.concatenate(counts).tolist()

    assert count(held, 0.0) == count(held, 0.2) == [0, 99, 0]
    if friction > 1e-31:
        assert count(held.at[..., :2].multiply(0.5), 0.0) == [99, 0, 0]


def test_no_contact_needs_no_iteration(system):
    poses = np.zeros((3, 2, 6))
    poses[..., 3], poses[..., 0] = -0.01, np.linspace(0, 5, 3)[:, None]
    skin, quality = follow(system, poses)
    assert not any(map(np.any, (skin.force, skin.displacement, quality.iterations)))


def test_a_scene_that_failed_is_not_waited_for_and_harms_no_other(system, slides):
    """One of two cannot converge: it says so, and costs no more than its failed increment."""
    poses = np.repeat(slides[:, 1:2], 2, axis=1)
    # the second one never touches, then is pressed hard in the first of the other's slides
    poses[1:, 1, 3] = 0.0
    poses[2:, 1, 3] = 40 * poses[-1, 0, 3]
    few = Solver(1e-3, limit=40)
    skin, quality = follow(system, poses, solver=few)
    assert (quality.residual_mm <= quality.tolerance_mm).tolist() == [True, False]
    assert np.all(np.isfinite(skin.force))
    assert int(quality.iterations[1]) <= 2 * (few.limit + BETWEEN_CHECKS)
    alone, _ = follow(system, poses[:, :1], solver=few)
    np.testing.assert_allclose(skin.force[0].sum(0), alone.force[0].sum(0), rtol=0.01, atol=1e-4)


def test_projection_is_idempotent_and_within_the_cone():
    force = jax.random.normal(jax.random.key(0), (3, 50, 3))
    friction = jnp.asarray([0.0, 0.3, 2.0])
    once = project(force, friction)
    np.testing.assert_allclose(project(once, friction), once, rtol=1e-6)
    pull = np.linalg.norm(once[..., :2], axis=-1)
    assert np.all(pull <= friction[:, None] * once[..., 2] * (1 + 1e-6))


@pytest.mark.parametrize("tilted", [False, True])
def test_no_product_is_left_to_the_rounding_of_a_gpu(system, tilted):
    path = jnp.zeros((2, 1, 6), jnp.float32)

    def run(path, system):
        start = make_undeformed_skins(system, path[0])
        return follow_path(make_problem(system, 1, 1.0, tilted), path, start, Solver(0.1, 9))

    text = jax.jit(run).lower(path, system).as_text()
    products = [line for line in text.splitlines() if "dot_general" in line]
    assert products and all("HIGHEST" in line for line in products)
