"""Derivatives of the pins against central differences, a closed form, and what must be exactly zero."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.checks.normal import SPHERE_MM, depth, load
from jaxunshear.checks.shear import FRICTION as MU
from jaxunshear.checks.shear import slip_distance
from jaxunshear.contact.friction import RHO, System, contact_state
from jaxunshear.contact.gradient import SWITCH_MM, path_shares, pin_gradient, pin_model, pins
from jaxunshear.contact.implicit import GOAL_MM, pin_state
from jaxunshear.contact.obstacle import Obstacles
from jaxunshear.contact.plan import LEVELS, increments
from jaxunshear.contact.simulate import follow
from jaxunshear.errors import UserError
from jaxunshear.scene.paths import Paths
from jaxunshear.scene.sensor import Sensor

SMALL = Sensor(name="small", rings=2, pin_spacing_mm=2.0, dome_radius_mm=8.0)  # a dome in a second
FLAT = Obstacles(jnp.full((1, 5, 5), -10.0))
STEP = 1e-6  # of central differences, mm, degrees or 1
FRICTION = np.array([0.3, 0.6, 1.0, 0.0, 0.8])


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXUNSHEAR_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def motions(generator, count):
    """Press, slide, then slide on with a twist and a tilt."""
    points = np.zeros((count, 4, 6))
    points[..., :2] = generator.uniform([-3, -1], [1, 1], (count, 1, 2))
    points[..., 2] = generator.uniform(-30, 30, (count, 1))
    points[:, 1:, 3] = generator.uniform(0.8, 1.4, (count, 1))
    points[:, 2:, :2] += generator.uniform(-0.6, 0.6, (count, 1, 2))
    points[:, 3, 2] += generator.uniform(-10, 10, count)
    points[:, 3, 4:] = generator.uniform(-8, 8, (count, 2))
    return points


@pytest.fixture(scope="module")
def paths():
    return Paths(np.zeros(len(FRICTION), int), FRICTION, motions(np.random.default_rng(3), len(FRICTION)))


@pytest.fixture(scope="module")
def found(paths):
    return pin_gradient(SMALL, ("disk",), paths)


@pytest.fixture(scope="module")
def model(paths):
    with jax.enable_x64(True):
        return pin_model(SMALL, ("disk",), paths)


run = jax.jit(pins)


def difference(model, points, friction, d_points=0.0, d_friction=0.0, d_log_ratio=0.0, step=STEP):
    """Central difference of the pins along a direction."""
    with jax.enable_x64(True):
        sides = [
            run(
                model,
                jnp.asarray(points + h * d_points),
                jnp.asarray(friction + h * d_friction),
                model.log_ratio + h * d_log_ratio,
            )
            for h in (step, -step)
        ]
        return np.asarray(sides[0].pins - sides[1].pins) / (2 * step)


def agree(derivative, expected, rel=1e-3):
    for scene, (ours, theirs) in enumerate(zip(derivative, expected, strict=True)):
        np.testing.assert_allclose(
            ours, theirs, rtol=0, atol=rel * np.abs(theirs).max() + 1e-8, err_msg=f"scene {scene}"
        )


def test_scenes_hold_every_state_and_no_switch(paths, model, found):
    assert found.converged.all() and not found.at_switch.any()
    assert np.all(found.margin_mm > 5 * STEP)  # else the differences below would prove nothing
    with jax.enable_x64(True):
        contacts, _ = follow(SMALL, ("disk",), paths, "reference")
    assert contacts.stuck.sum() > 9 and contacts.slipping.sum() > 20 and np.all(contacts.free > 20)
    assert np.sqrt(np.mean(np.sum((contacts.pins - found.pins) ** 2, -1))) < 0.02  # finer increments


@pytest.mark.parametrize("point", [1, 2, 3])
@pytest.mark.parametrize("column", range(6), ids=("x", "y", "yaw", "depth", "tilt_x", "tilt_y"))
def test_way_points(paths, model, found, point, column):
    direction = np.zeros((4, 6))
    direction[point, column] = 1
    agree(found.d_points[..., point, column], difference(model, paths.points, FRICTION, d_points=direction))


def test_friction(paths, model, found):
    moved = (FRICTION > 0).astype(float)
    agree(found.d_friction[FRICTION > 0], difference(model, paths.points, FRICTION, d_friction=moved)[FRICTION > 0])
    with jax.enable_x64(True):  # from no friction there is one way to go
        more = (
            run(model, paths.points, jnp.asarray(FRICTION + 1e-6)).pins
            - run(model, paths.points, jnp.asarray(FRICTION)).pins
        )
    agree(found.d_friction[FRICTION == 0], np.asarray(more)[FRICTION == 0] / 1e-6)


def test_moduli(paths, model, found):
    agree(found.d_log_ratio, difference(model, paths.points, FRICTION, d_log_ratio=1.0))
    with jax.enable_x64(
        True
    ):  # and between domes of other moduli; the gel's counts as little as the skin's, the ratio alone
        step = 1e-3
        sides = [
            run(
                pin_model(replace(SMALL, skin_modulus_mpa=5 * np.exp(h), gel_modulus_mpa=0.5), ("disk",), paths),
                paths.points,
                FRICTION,
            )
            for h in (step, -step)
        ]
    smooth = found.margin_mm > 1e-4
    assert smooth.any()
    agree(found.d_log_ratio[smooth], np.asarray(sides[0].pins - sides[1].pins)[smooth] / (2 * step))


def test_backwards_equals_forwards_and_jit_and_vmap(paths, model, found):
    weights = np.random.default_rng(0).normal(size=found.pins.shape)
    with jax.enable_x64(True):
        at = jnp.asarray(paths.points), jnp.asarray(FRICTION), model.log_ratio
        loss = lambda *x: jnp.sum(weights * pins(model, *x).pins)  # noqa: E731
        back = jax.grad(loss, argnums=(0, 1, 2))(*at)  # without jit
        np.testing.assert_allclose(back[0], np.einsum("bpc,bpckx->bkx", weights, found.d_points), rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(back[1], np.einsum("bpc,bpc->b", weights, found.d_friction), rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(back[2], np.sum(weights * found.d_log_ratio), rtol=1e-6)
        many = jax.jit(jax.vmap(jax.grad(lambda friction: loss(at[0], friction, at[2]))))(
            jnp.stack([at[1], 0.9 * at[1]])
        )
        np.testing.assert_allclose(many[0], back[1], rtol=1e-6, atol=1e-8)
        other = jax.grad(lambda friction: loss(at[0], friction, at[2]))(0.9 * at[1])
        np.testing.assert_allclose(many[1], other, rtol=1e-6, atol=1e-8)
        few = replace(model, most=2)  # more nodes touch than foreseen
        np.testing.assert_allclose(
            jax.grad(lambda x: jnp.sum(weights * pins(few, at[0], x).pins))(at[1]), back[1], rtol=1e-6, atol=1e-8
        )


def test_what_touches_nothing_answers_to_nothing():
    points = np.zeros((2, 3, 6))
    points[:, :, 0] = [[0, 1, 2], [0, -1, -2]]
    points[:, 1:, 3] = -0.01
    found = pin_gradient(SMALL, ("disk",), Paths(np.zeros(2, int), np.array([0.5, 0.0]), points))
    assert not any(np.any(slope) for slope in (found.d_points, found.d_friction, found.d_log_ratio))
    assert found.converged.all() and not found.at_switch.any()
    assert found.margin_mm[0] == pytest.approx(0.01)  # the apex' gap


def test_pure_stick_does_not_answer_to_friction():
    points = np.zeros((2, 3, 6))
    points[:, :, 0] = -3
    points[:, 1:, 3] = 0.3
    points[:, 2, :2] += [0.01, 0.005]
    paths = Paths(np.zeros(2, int), np.array([5.0, np.inf]), points)
    found = pin_gradient(SMALL, ("disk",), paths)
    assert found.converged.all()
    assert not np.any(found.d_friction)
    with jax.enable_x64(True):
        model = pin_model(SMALL, ("disk",), paths)
    direction = np.zeros((3, 6))
    direction[2, 0] = 1
    agree(found.d_points[..., 2, 0], difference(model, points, paths.friction, d_points=direction))
    np.testing.assert_allclose(found.pins[0], found.pins[1], atol=1e-9)  # 5 sticks as infinity does


def test_a_switch_is_flagged_and_one_sided():
    """The dome just comes to the surface: less depth changes nothing, more depth does."""
    points = np.zeros((1, 2, 6))
    points[:, :, 0], points[:, 0, 3] = -3, -0.1
    paths = Paths(np.zeros(1, int), np.array([0.5]), points)
    found = pin_gradient(SMALL, ("disk",), paths)
    assert found.at_switch[0] and found.margin_mm[0] < SWITCH_MM
    with jax.enable_x64(True):
        model = pin_model(SMALL, ("disk",), paths)
        at = lambda depth: np.asarray(run(model, jnp.asarray(points).at[0, 1, 3].set(depth), paths.friction).pins)  # noqa: E731
        up, down = (at(0.0) - at(-1e-4)) / 1e-4, (at(1e-4) - at(0.0)) / 1e-4
    np.testing.assert_array_equal(found.d_points[..., 1, 3], up)
    assert np.abs(down).max() > 0.1


def test_going_on_from_a_skin(paths):
    slides = Paths(paths.stimulus[:2], paths.friction[:2], paths.points[:2, :3])
    whole = pin_gradient(SMALL, ("disk",), slides, "reference")
    pressed = Paths(slides.stimulus, slides.friction, slides.points[:, :2])
    moved = Paths(slides.stimulus, slides.friction, slides.points[:, 1:])
    _, skins = follow(SMALL, ("disk",), pressed, "reference")
    rest = pin_gradient(SMALL, ("disk",), moved, "reference", start=skins)
    np.testing.assert_allclose(rest.pins, whole.pins, atol=5e-3)  # as exact as the reference level is
    agree(rest.d_points[..., -1, :], whole.d_points[..., -1, :], rel=0.05)


def test_shares_cut_a_path_as_the_plan_does(paths):
    points = paths.points.copy()
    points[0, 2:] = points[0, 1]  # legs without length
    points[1, 1] = points[1, 0]
    paths = Paths(paths.stimulus, paths.friction, points)
    for name in ("auto", "default"):
        poses, _ = increments(paths, LEVELS[name], SMALL.dome_radius_mm)
        points = np.array(paths.points)
        points[..., [2, 4, 5]] = np.radians(points[..., [2, 4, 5]])
        shares = path_shares(paths, LEVELS[name], SMALL.dome_radius_mm)
        np.testing.assert_allclose(np.einsum("btk,bkc->btc", shares, points), poses, atol=1e-12)
        np.testing.assert_allclose(shares.sum(-1), 1)


def test_between_ratios_the_compliance_is_that_of_a_dome(paths):
    with jax.enable_x64(True):
        several = pin_model(SMALL, ("disk",), paths, ratios=(5.0, 10.0, 20.0))
        for ratio, most in ((10.0, 1e-9), (14.0, 2e-3)):  # at a knot, between
            single = pin_model(replace(SMALL, skin_modulus_mpa=0.1 * ratio), ("disk",), paths)
            apart = run(several, paths.points, FRICTION, jnp.log(ratio)).pins - run(single, paths.points, FRICTION).pins
            assert float(jnp.abs(apart).max()) < most
    with pytest.raises(UserError, match="ratios"), jax.enable_x64(True):
        pin_model(SMALL, ("disk",), paths, ratios=(10.0, 5.0))


def test_cattaneo_mindlin_by_friction_and_slide(half_space):
    """Q = mu P [1 - (1 - x / s)^1.5], s = 3 mu P / (16 a G*), differentiated by the slide x and by mu."""
    radius, share = 0.45, 0.6
    near = np.flatnonzero(half_space.radius < 1.4 * radius)
    rows = (3 * near[:, None] + np.arange(3)).ravel()
    scale = float(np.trace(half_space.w[np.ix_(rows, rows)])) / len(rows)
    pressed, slide = load(half_space, radius), share * slip_distance(half_space, radius)
    with jax.enable_x64(True):
        w = jnp.asarray(half_space.w[np.ix_(rows, rows)] / scale)
        nodes = np.column_stack([half_space.nodes[near, :2], half_space.sphere(SPHERE_MM)[near]])
        system = System(w, jnp.linalg.inv(w + RHO * jnp.eye(len(w))), w, jnp.asarray(nodes), jnp.zeros(()))

        def pull(slide, mu):
            path = jnp.zeros((10, 1, 6)).at[1:, 0, 3].set(depth(radius)).at[2:, 0, 0].set(jnp.arange(1, 9) / 8 * slide)
            state = pin_state(system, jnp.zeros((len(w), 3)), FLAT, jnp.zeros(1, jnp.int32), mu[None], path)
            return -jnp.sum(state.skin.force[0, :, 0]) / scale, state

        at = jnp.asarray(slide), jnp.asarray(MU)
        (by_slide, by_mu), state = jax.jit(jax.jacfwd(pull, argnums=(0, 1), has_aux=True))(*at)
        stuck, slipping, free = contact_state(state.skin, at[1][None])
    assert float(state.residual_mm[0]) < GOAL_MM["float64"]
    assert min(int(stuck[0]), int(slipping[0]), int(free[0])) > 0
    root = np.sqrt(1 - share)
    assert float(by_slide) == pytest.approx(1.5 * MU * pressed * share / slide * root, rel=0.03)
    assert float(by_mu) == pytest.approx(pressed * (1 - root**3 - 1.5 * share * root), rel=0.06)
