"""Derivatives of the pins against central differences, a closed form, and exact zeros."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.sensor import Sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator.contact_problem import RHO, ContactProblem, System, make_undeformed_skins
from jaxunshear.simulator.gradient import (
    PinPositions,
    compute_path_shares,
    make_pin_model,
    simulate_pins,
)
from jaxunshear.simulator.implicit import GOAL_MM, compute_pin_state
from jaxunshear.simulator.level import LEVELS
from jaxunshear.simulator.paths import Paths, cut_increments
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import Obstacles
from verification.normal_contact import SPHERE_MM, compute_hertz_depth, compute_hertz_load
from verification.tangential_contact import FRICTION as MU
from verification.tangential_contact import compute_slip_distance

SMALL = Sensor(name="small", rings=2, pin_spacing_mm=2.0, dome_radius_mm=8.0)  # a dome in a second
DISK = ("disk",)
FLAT = Obstacles(jnp.full((1, 5, 5), -10.0))
SWITCH_MM = 1e-6  # nearer than this, rounding decides on which side of a switch a node is
STEP = 1e-6  # of central differences, mm, degrees or 1
FRICTION = np.array([0.3, 0.6, 1.0, 0.0, 0.8])


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXUNSHEAR_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def draw_paths():
    """Press, slide, then slide on with a twist and a tilt."""
    generator, count = np.random.default_rng(3), len(FRICTION)
    points = np.zeros((count, 4, 6))
    points[..., :2] = generator.uniform([-3, -1], [1, 1], (count, 1, 2))
    points[..., 2] = generator.uniform(-30, 30, (count, 1))
    points[:, 1:, 3] = generator.uniform(0.8, 1.4, (count, 1))
    points[:, 2:, :2] += generator.uniform(-0.6, 0.6, (count, 1, 2))
    points[:, 3, 2] += generator.uniform(-10, 10, count)
    points[:, 3, 4:] = generator.uniform(-8, 8, (count, 2))
    return Paths(np.zeros(count, int), FRICTION, points)


def draw_special_paths():
    """Two that touch nothing, two that stick, and one that comes down until it just touches."""
    points = np.zeros((5, 3, 6))
    points[:, :, 0] = [[0, 1, 2], [0, -1, -2], [-3, -3, -2.99], [-3, -3, -2.99], [-3, -3, -3]]
    points[2:4, 2, 1] = 0.005
    points[:2, 1:, 3], points[2:4, 1:, 3], points[4, :, 3] = -0.01, 0.3, [-0.1, -0.05, 0]
    return Paths(np.zeros(5, int), np.array([0.5, 0.0, 5.0, np.inf, 0.5]), points)


class Gradient(NamedTuple):
    positions: PinPositions
    d_points: np.ndarray  # (B, P, 3, K, 6)
    d_friction: np.ndarray  # (B, P, 3)
    d_log_ratio: np.ndarray  # (B, P, 3)


@jax.jit
def push_tangents(model, points, friction):
    """Differentiate by one tangent for all scenes at once."""
    count, ways = len(points), points[0].size
    each = jnp.eye(ways + 2, ways).reshape(-1, 1, *points.shape[1:])
    tangents = (
        jnp.broadcast_to(each, (ways + 2, *points.shape)),
        jnp.zeros((ways + 2, count)).at[ways].set(1.0),
        jnp.zeros(ways + 2).at[ways + 1].set(1.0),
    )

    def push(*tangent):
        def simulate(*inputs):
            positions = simulate_pins(model, *inputs)
            return positions.pins, positions

        inputs = (points, friction, model.log_ratio)
        return jax.jvp(simulate, inputs, tangent, has_aux=True)[1:]

    slopes, positions = jax.vmap(push, out_axes=(-1, None))(*tangents)
    by_points = slopes[..., :ways].reshape(*slopes.shape[:-1], *points.shape[1:])
    return Gradient(positions, by_points, slopes[..., ways], slopes[..., ways + 1])


def make_model(paths, sensor=SMALL, **options):
    with jax.enable_x64(True):
        return make_pin_model(sensor, DISK, paths, **options)


run = jax.jit(simulate_pins)


class Scenario:
    """Paths, their model, and its derivatives."""

    def __init__(self, paths):
        self.paths, self.model = paths, make_model(paths)
        with jax.enable_x64(True):
            given = jnp.asarray(paths.points), jnp.asarray(paths.friction)
            self.found = jax.device_get(push_tangents(self.model, *given))

    def simulate(self, model=None, d_points=0.0, d_friction=0.0, d_log_ratio=0.0):
        """Simulate the pins, perhaps of a changed model or with changed inputs."""
        model = model or self.model
        points, friction = self.paths.points + d_points, self.paths.friction + d_friction
        with jax.enable_x64(True):
            given = jnp.asarray(points), jnp.asarray(friction), model.log_ratio + d_log_ratio
            return np.asarray(run(model, *given).pins)

    def differ(self, **directions):
        """Compute the central difference of the pins along a direction."""
        above, below = (
            self.simulate(**{name: h * way for name, way in directions.items()})
            for h in (STEP, -STEP)
        )
        return (above - below) / (2 * STEP)


@pytest.fixture(scope="module")
def moved():
    return Scenario(draw_paths())


@pytest.fixture(scope="module")
def special():
    return Scenario(draw_special_paths())


def check_agreement(derivative, expected, rel=1e-3):
    for scene, (ours, theirs) in enumerate(zip(derivative, expected, strict=True)):
        atol = rel * np.abs(theirs).max() + 1e-8
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol, err_msg=f"scene {scene}")


def test_scenes_hold_every_state_and_no_switch(moved):
    positions = moved.found.positions
    assert np.all(positions.residual_mm <= GOAL_MM["float64"])
    # else the differences below would prove nothing
    assert np.all(positions.margin_mm > 5 * STEP)
    with jax.enable_x64(True):
        contacts, _ = follow(SMALL, DISK, moved.paths, "reference")
    assert contacts.stuck_nodes.sum() > 9 and contacts.slipping_nodes.sum() > 20
    # finer increments
    assert np.sqrt(np.mean(np.sum((contacts.pins - positions.pins) ** 2, -1))) < 0.02


def test_way_points_together(moved):
    """Along a direction that moves every coordinate of every way point but the first."""
    direction = np.random.default_rng(7).normal(size=(4, 6)) * [0.1, 0.1, 1, 0.1, 1, 1]
    direction[0] = 0
    derivative = np.einsum("bpckx,kx->bpc", moved.found.d_points, direction)
    check_agreement(derivative, moved.differ(d_points=direction))


@pytest.mark.long
@pytest.mark.parametrize("point", [1, 2, 3])
@pytest.mark.parametrize("column", range(6), ids=("x", "y", "yaw", "depth", "tilt_x", "tilt_y"))
def test_way_points(moved, point, column):
    direction = np.zeros((4, 6))
    direction[point, column] = 1
    check_agreement(moved.found.d_points[..., point, column], moved.differ(d_points=direction))


def test_friction(moved):
    rubs, slopes = FRICTION > 0, moved.found.d_friction
    check_agreement(slopes[rubs], moved.differ(d_friction=rubs.astype(float))[rubs])
    # from none there is one way to go
    more = (moved.simulate(d_friction=STEP) - moved.simulate()) / STEP
    check_agreement(slopes[~rubs], more[~rubs])


def test_moduli(moved):
    check_agreement(moved.found.d_log_ratio, moved.differ(d_log_ratio=1.0))
    sides, step = [], 1e-3  # and between domes of other moduli, of which only the ratio counts
    for h in (step, -step):
        other = replace(SMALL, skin_modulus_mpa=5 * np.exp(h), gel_modulus_mpa=0.5)
        sides.append(moved.simulate(make_model(moved.paths, other)))
    smooth = moved.found.positions.margin_mm > 1e-4
    assert smooth.any()
    slope = (sides[0] - sides[1]) / (2 * step)
    check_agreement(moved.found.d_log_ratio[smooth], slope[smooth])


def test_more_nodes_may_touch_than_foreseen(moved):
    few = moved.simulate(replace(moved.model, max_touching=2))
    np.testing.assert_allclose(few, moved.found.positions.pins, atol=1e-9)


@pytest.mark.long
def test_backwards_equals_forwards_under_vmap(moved):
    found, model = moved.found, moved.model
    weights = np.random.default_rng(0).normal(size=found.positions.pins.shape)

    def compute_loss(model, *x):
        return jnp.sum(weights * simulate_pins(model, *x).pins)

    with jax.enable_x64(True):
        given = jnp.asarray(moved.paths.points), jnp.asarray([FRICTION, 0.9 * FRICTION])
        slopes = jax.vmap(jax.grad(compute_loss, (1, 2, 3)), (None, None, 0, None))
        back = jax.device_get(jax.jit(slopes)(model, *given, model.log_ratio))
    forwards = (
        np.einsum("bpc,bpckx->bkx", weights, found.d_points),
        np.einsum("bpc,bpc->b", weights, found.d_friction),
        np.sum(weights * found.d_log_ratio),
    )
    for one, other in zip(back, forwards, strict=True):
        np.testing.assert_allclose(one[0], other, rtol=1e-6, atol=1e-8)
    rubs = (FRICTION > 0).astype(float)
    less = Paths(moved.paths.stimulus, 0.9 * FRICTION, moved.paths.points)
    expected = np.einsum("bpc,bpc->b", weights, Scenario(less).differ(d_friction=rubs))
    np.testing.assert_allclose(back[1][1] * rubs, expected, rtol=1e-3, atol=1e-6)


def test_no_contact_has_no_derivative(special):
    positions, *slopes = special.found
    assert not any(np.any(slope[:2]) for slope in slopes)
    assert np.all(positions.residual_mm <= GOAL_MM["float64"])
    # the apex' gap after the first of three increments
    assert positions.margin_mm[1] == pytest.approx(0.01 / 3)


def test_pure_stick_does_not_depend_on_friction(special):
    assert not np.any(special.found.d_friction[2:4])
    direction = np.zeros((3, 6))
    direction[2, 0] = 1
    slopes = special.found.d_points[2:4, ..., 2, 0]
    check_agreement(slopes, special.differ(d_points=direction)[2:4])
    strong, infinite = special.found.positions.pins[2:4]  # 5 sticks as infinity does
    np.testing.assert_allclose(strong, infinite, atol=1e-9)


def test_a_switch_is_flagged_and_one_sided(special):
    """The dome just comes to the surface: less depth changes nothing, more depth does."""
    assert list(special.found.positions.margin_mm < SWITCH_MM) == [False] * 4 + [True]
    deeper = np.zeros((5, 3, 6))
    deeper[4, 2, 3] = STEP
    shallow, here, deep = (special.simulate(d_points=sign * deeper)[4] for sign in (-1, 0, 1))
    less, more = (here - shallow) / STEP, (deep - here) / STEP
    assert np.abs(more).max() > 0.1 and np.abs(less).max() < 1e-9
    slope = special.found.d_points[4, ..., 2, 3]  # rounding decides which of the two
    assert min(np.abs(slope - less).max(), np.abs(slope - more).max()) < 1e-3 * np.abs(more).max()


@pytest.mark.parametrize("name", ["auto", "default"])
def test_shares_cut_a_path_as_the_plan_does(name):
    paths = draw_paths()
    paths.points[0, 2:] = paths.points[0, 1]  # legs without length
    paths.points[1, 1] = paths.points[1, 0]
    poses, _ = cut_increments(paths, LEVELS[name], SMALL.dome_radius_mm)
    shares = compute_path_shares(paths, LEVELS[name], SMALL.dome_radius_mm)
    np.testing.assert_allclose(np.einsum("btk,bkc->btc", shares, paths.radians), poses, atol=1e-12)
    np.testing.assert_allclose(shares.sum(-1), 1)


def test_between_ratios_the_compliance_is_that_of_a_dome():
    paths = draw_paths()
    several = make_model(paths, ratios=(5.0, 10.0, 20.0))
    for ratio, most in ((10.0, 1e-12), (14.0, 1e-3)):  # at a knot, between
        single = make_model(paths, replace(SMALL, skin_modulus_mpa=0.1 * ratio))
        with jax.enable_x64(True):
            ours = jax.device_get(several.compliances.interpolate(jnp.log(ratio)))
            theirs = jax.device_get(single.compliances.interpolate(single.log_ratio))
        for one, other in zip(ours, theirs, strict=True):
            assert np.abs(one - other).max() < most * np.abs(other).max()
    with pytest.raises(UserError, match="ratios"):
        make_model(paths, ratios=(10.0, 5.0))


def test_half_space_in_stick_and_in_slip(half_space):
    """A stuck disk has dQ/dx = 8 a G* by its slide x, a slipping one dQ/dmu = P by friction."""
    radius, slide = 0.45, 1.5 * compute_slip_distance(half_space, 0.45)
    near = np.flatnonzero(half_space.radius < 1.2 * radius)
    rows = (3 * near[:, None] + np.arange(3)).ravel()
    scale = float(np.trace(half_space.w[np.ix_(rows, rows)])) / len(rows)
    nodes = np.column_stack([half_space.nodes[near, :2], half_space.sphere(SPHERE_MM)[near]])
    with jax.enable_x64(True):
        w = jnp.asarray(half_space.w[np.ix_(rows, rows)] / scale)
        inverse = jnp.linalg.inv(w + RHO * jnp.eye(len(w)))
        zero = jnp.zeros(())
        system = System(w, inverse, w, jnp.asarray(nodes), zero, zero)

        def compute_pull(slide, friction):
            path = jnp.zeros((4, 2, 6)).at[1:, :, 3].set(compute_hertz_depth(radius))
            path = path.at[2:, :, 0].set(jnp.outer(jnp.arange(1, 3) / 2, slide))
            problem = ContactProblem(system, FLAT, jnp.zeros(2, jnp.int32), friction, tilted=True)
            skin = make_undeformed_skins(system, path[0])
            state = compute_pin_state(problem, jnp.zeros((len(w), 3)), path, skin)
            return -jnp.sum(state.skin.force[..., 0], axis=1) / scale, state.residual_mm

        values = jnp.full(2, slide), jnp.array([jnp.inf, MU])
        differentiate = jax.jit(jax.jacfwd(compute_pull, (0, 1), has_aux=True))
        (by_slide, by_friction), residual = jax.device_get(differentiate(*values))
    assert np.all(residual < GOAL_MM["float64"])
    stuck, slipping = np.diag(by_slide)
    assert stuck == pytest.approx(8 * radius * half_space.pull_modulus, rel=0.03)
    assert abs(slipping) < 1e-2 * stuck
    unmoved, weighed = np.diag(by_friction)
    assert unmoved == 0
    assert weighed == pytest.approx(compute_hertz_load(half_space, radius), rel=0.03)
    assert not np.any(by_slide - np.diag(np.diag(by_slide)))  # no scene knows of another
