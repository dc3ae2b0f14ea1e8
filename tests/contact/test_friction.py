"""Contact on a half-space against Hertz, Cattaneo and Mindlin, and the laws that every answer must obey."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.contact.friction import contact_state, follow_path, project, rest
from tests.contact.conftest import FLAT

SPHERE_MM, DEPTH_MM, FRICTION = 8.0, 0.06, 0.5
RADIUS_MM = np.sqrt(SPHERE_MM * DEPTH_MM)


def follow(system, path, friction, tolerance=1e-3):
    path = jnp.asarray(path, jnp.float32)
    count = path.shape[1]
    friction = jnp.full(count, friction, jnp.float32)
    skin, quality = follow_path(
        system, FLAT, jnp.zeros(count, jnp.int32), friction, path[1:], rest(system, path[0]), tolerance, 4000
    )
    assert np.all(quality.residual_mm <= quality.tolerance_mm)
    return skin, quality


def press(slide=(0.0, 0.0), steps=8):
    path = np.zeros((2 + steps, 1, 6))
    path[1:, 0, 3] = DEPTH_MM
    path[2:, 0, :2] = np.linspace(0, 1, steps + 1)[1:, None] * np.asarray(slide)
    return path


def slip_distance(half_space):
    """The slide after which a stuck contact slips as a whole: 3 mu P / (16 a G*)."""
    load = 4 / 3 * half_space.normal_modulus * np.sqrt(SPHERE_MM) * DEPTH_MM**1.5
    return 3 * FRICTION * load / (16 * RADIUS_MM * half_space.shear_modulus / (2 - half_space.poisson))


def test_hertz(half_space):
    skin, _ = follow(half_space.system(SPHERE_MM), press(steps=1), 0.0, 1e-4)
    pressure = np.asarray(skin.force)[0, :, 2] / half_space.scale
    load = 4 / 3 * half_space.normal_modulus * np.sqrt(SPHERE_MM) * DEPTH_MM**1.5
    assert pressure.sum() == pytest.approx(load, rel=0.03)  # 2.6 % here: a body of 60 mm clamped far away, not endless
    squares = np.sum(half_space.compliance.nodes[:, :2] ** 2, -1)
    radius = np.sqrt(2.5 * np.sum(pressure * squares) / pressure.sum())  # of a Hertzian pressure, by its second moment
    assert radius == pytest.approx(RADIUS_MM, rel=0.01)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 1.5])
def test_cattaneo_mindlin(half_space, share):
    skin, _ = follow(half_space.system(SPHERE_MM), press((share * slip_distance(half_space), 0.0)), FRICTION)
    force = np.asarray(skin.force)[0].sum(0)
    expected = 1 - max(0.0, 1 - share) ** 1.5
    assert float(-force[0] / (FRICTION * force[2])) == pytest.approx(float(expected), rel=0.01)
    assert abs(force[1]) < 1e-3 * force[2]
    stuck, slipping, free = contact_state(skin, jnp.asarray([FRICTION]))
    assert int(stuck[0] + slipping[0] + free[0]) == len(half_space.compliance.nodes)
    assert (int(stuck[0]) == 0) == (share > 1)


def test_laws_of_every_answer(half_space):
    system = half_space.system(SPHERE_MM)
    path = np.concatenate([press((0.03, 0.01)), press((-0.02, 0.02))[2:]])
    skin, _ = follow(system, path, FRICTION)
    force = np.asarray(skin.force)[0]
    pull = np.linalg.norm(force[:, :2], axis=-1)
    assert np.all(force[:, 2] >= 0) and np.all(pull <= FRICTION * force[:, 2] * (1 + 1e-5))
    gap = np.asarray(system.nodes[:, 2] - DEPTH_MM + skin.displacement[0, :, 2])
    assert gap.min() > -1e-4
    assert np.abs(gap * force[:, 2]).max() < 1e-4 * force[:, 2].max()


def test_a_cycle_dissipates(half_space):
    """The work of the slide over a closed path is the heat of friction: positive, and nothing without friction."""
    system = half_space.system(SPHERE_MM)
    reach = 0.8 * slip_distance(half_space)
    forward = np.linspace(0, 1, 7)[1:]
    along = reach * np.concatenate(
        [[0.0], forward, 1 - 2 * forward, -1 + forward, forward, 1 - 2 * forward, -1 + 2 * forward]
    )
    work = {}
    for friction in (0.0, FRICTION):
        position = np.zeros((1, 6))
        position[0, 3] = DEPTH_MM
        skin, _ = follow(system, np.stack([np.zeros((1, 6)), position]), friction)
        pulls = [0.0]
        for place in along[1:]:
            position = np.array([[place, 0.0, 0.0, DEPTH_MM, 0.0, 0.0]])
            arguments = (FLAT, jnp.zeros(1, jnp.int32), jnp.asarray([friction], jnp.float32))
            skin, _ = follow_path(system, *arguments, jnp.asarray(position, jnp.float32)[None], skin, 1e-3, 4000)
            pulls.append(-float(skin.force[0, :, 0].sum()))
        pulls = np.array(pulls)
        cycle = slice(len(along) - 13, len(along))  # from +reach to -reach and back
        work[friction] = np.sum(np.diff(along[cycle]) * (pulls[cycle][1:] + pulls[cycle][:-1]) / 2)
    assert abs(work[0.0]) < 1e-6
    load = float(skin.force[0, :, 2].sum())
    x = float(pulls[-1] / (FRICTION * load))  # Mindlin and Deresiewicz 1953
    stiffness = half_space.shear_modulus / (2 - half_space.poisson) * half_space.scale
    expected = (
        9
        * (FRICTION * load) ** 2
        / (10 * RADIUS_MM * stiffness)
        * (1 - (1 - x) ** (5 / 3) - 5 * x / 6 * (1 + (1 - x) ** (2 / 3)))
    )
    assert work[FRICTION] == pytest.approx(expected, rel=0.06)  # 4 % here: trapezia over steps of a sixth of the stroke


def test_no_contact_is_exactly_zero(half_space):
    path = np.zeros((3, 2, 6))
    path[:, :, 3] = -0.01
    path[:, :, 0] = np.linspace(0, 5, 3)[:, None]
    skin, quality = follow(half_space.system(SPHERE_MM), path, FRICTION)
    assert not np.any(skin.force) and not np.any(skin.displacement)
    assert not np.any(quality.iterations)


def test_no_friction_no_pull(half_space):
    skin, _ = follow(half_space.system(SPHERE_MM), press((0.05, 0.0)), 0.0)
    assert not np.any(np.asarray(skin.force)[..., :2])


def test_turning_the_slide_turns_the_answer(half_space):
    system = half_space.system(SPHERE_MM)
    angle = np.pi / 3
    slide = 0.7 * slip_distance(half_space)
    straight, _ = follow(system, press((slide, 0.0)), FRICTION)
    turned, _ = follow(system, press((slide * np.cos(angle), slide * np.sin(angle))), FRICTION)
    first, second = np.asarray(straight.force)[0].sum(0), np.asarray(turned.force)[0].sum(0)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    np.testing.assert_allclose(second[:2], rotation @ first[:2], atol=2e-3 * first[2])
    assert float(second[2]) == pytest.approx(float(first[2]), rel=1e-4)


def test_twisting_pulls_around_the_axis(half_space):
    """A full-slip twist holds M = 3 pi / 16 mu P a."""
    path = np.zeros((8, 1, 6))
    path[1:, 0, 3] = DEPTH_MM
    path[2:, 0, 2] = np.radians(np.linspace(0, 60, 7)[1:])
    skin, _ = follow(half_space.system(SPHERE_MM), path, FRICTION)
    nodes, force = half_space.compliance.nodes, np.asarray(skin.force)[0]
    moment = -np.sum(nodes[:, 0] * force[:, 1] - nodes[:, 1] * force[:, 0])
    assert float(moment) == pytest.approx(float(3 * np.pi / 16 * FRICTION * force[:, 2].sum() * RADIUS_MM), rel=0.02)


def test_projection_and_jit():
    force = jax.random.normal(jax.random.key(0), (3, 50, 3))
    friction = jnp.asarray([0.0, 0.3, 2.0])
    once = project(force, friction)
    np.testing.assert_allclose(project(once, friction), once, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(project)(force, friction), once, rtol=1e-6)
    assert np.all(np.linalg.norm(once[..., :2], axis=-1) <= friction[:, None] * once[..., 2] * (1 + 1e-6))
