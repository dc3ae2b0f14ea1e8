"""Networks over pins: shapes, what reaches what, pins that are not seen, motions on a grid."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.networks import PinPoseNet, PinRenderer, PinUnshear
from jaxunshear.errors import Note, UserError
from jaxunshear.models import distances
from jaxunshear.models.pin_networks import (
    add_noise,
    decode_canonical,
    decode_sheared,
    encode,
    fold_tasks,
    give_tasks,
    init,
    make_grid,
    predict,
    reconstruct,
    render_pins,
    unfold_tasks,
    unshear,
)
from jaxunshear.models.reconstruction import measure_disagreement
from tests.helpers.network_parts import drop_parts, find_taught_parts

SMALL = {"hidden": 16, "layers": 2, "pose_code": 5, "shear_code": 2}
REST = np.random.default_rng(0).uniform(10, 100, (19, 2)).astype(np.float32)


@functools.cache
def made(kind, outputs=0, **changes):
    net = kind(**SMALL | changes)
    return net, jax.jit(lambda key: init(net, REST, 1.5, key, outputs))(jax.random.key(0))


def moved(seed=1, count=3):
    motion = np.random.default_rng(seed).normal(0, 1.5, (count, *REST.shape))
    return jnp.asarray(REST + motion, jnp.float32)


@pytest.mark.parametrize(
    ("jit", "changes"),
    [(False, {}), (True, {}), (True, {"conv_channels": (4, 6), "separate_encoders": True})],
)
def test_shapes_and_batches(jit, changes):
    net, variables = made(PinUnshear, **changes)
    run = jax.jit(unshear, static_argnums=0) if jit else unshear
    pins = moved()
    z_p, z_s = encode(net, variables, pins)
    assert (z_p.shape, z_s.shape) == ((3, 5), (3, 2))
    canonical = run(net, variables, pins)
    assert canonical.shape == decode_sheared(net, variables, z_p, z_s).shape == pins.shape
    alone = run(net, variables, pins[1:2])[0]
    np.testing.assert_allclose(alone, canonical[1], rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("separate_encoders", [False, True])
def test_released_weights_give_the_pose_code_and_say_so(separate_encoders):
    net, variables = made(PinUnshear, separate_encoders=separate_encoders)
    released, pins = drop_parts(variables, "shear", "DS", "ES"), moved()
    with pytest.warns(Note, match="z_p alone"):
        z_p, z_s = encode(net, released, pins)
    codes = encode(net, variables, pins)
    assert z_s is None
    np.testing.assert_array_equal(z_p, codes[0])
    np.testing.assert_array_equal(unshear(net, released, pins), unshear(net, variables, pins))
    with pytest.raises(UserError, match="no DS"):
        decode_sheared(net, released, *codes)


def test_the_canonical_pins_do_not_know_the_shear_code():
    """By gradients that are exactly zero: of DC's answer to the shear code's layer, and to DS."""
    net, variables = made(PinUnshear)

    def draw(given):
        return unshear(net, given, moved())

    assert find_taught_parts(draw, variables) == {"E", "pose", "DC"}


def test_no_shear_code_builds_no_ds():
    net, variables = made(PinUnshear, shear_code=0)
    assert set(variables["params"]) == {"E", "pose", "DC"}
    assert encode(net, variables, moved())[1] is None


@pytest.mark.parametrize("conv_channels", [(), (4, 6)])
def test_a_pin_that_is_not_seen_counts_as_one_that_has_not_moved(conv_channels):
    net, variables = made(PinPoseNet, 4, conv_channels=conv_channels)
    pins = moved()
    outputs = predict(net, variables, pins.at[:, 7].set(jnp.nan))
    assert outputs.shape == (3, 4) and np.isfinite(outputs).all()
    still = pins.at[:, 7].set(REST[7])
    np.testing.assert_array_equal(outputs, predict(net, variables, still))
    assert np.isfinite(unshear(*made(PinUnshear), jnp.full_like(pins, jnp.nan))).all()


def test_what_convolves_has_no_dense_trunk_and_sees_every_pin():
    net, variables = made(PinUnshear, conv_channels=(4, 6))
    posenet, weights = made(PinPoseNet, 4, conv_channels=(4, 6))
    norms = {f"LayerNorm_{i}" for i in range(3)}
    assert set(variables["params"]["E"]) == {"Conv_0", "Conv_1", "Dense_0"} | norms
    assert set(variables["params"]["DC"]) == {"Trunk_0", "Dense_0"}
    assert set(weights["params"]) == {"GridTrunk_0", "Dense_0"}
    pins = moved()
    for compute in (
        lambda pins: encode(net, variables, pins)[0],
        lambda pins: predict(posenet, weights, pins),
    ):
        slopes = jax.jit(jax.grad(lambda pins, run=compute: jnp.sum(run(pins))))(pins)
        assert jnp.all(jnp.any(slopes != 0, axis=-1))
        np.testing.assert_allclose(compute(pins[1:2])[0], compute(pins)[1], atol=1e-5)


def test_distance_is_in_units_of_the_spread_and_skips_what_is_not_seen():
    _, variables = made(PinUnshear)
    target = moved()

    def measure(pins, target):
        return distances.compute_pin_distance(pins, target, variables)

    assert float(measure(target + 3.0, target)[0]) == pytest.approx(4.0, rel=1e-5)
    holes = target.at[0, :10].set(jnp.nan)
    far = target.at[0, :10].add(100.0) + 1.5
    assert float(measure(far, holes)[0]) == pytest.approx(1.0, rel=1e-5)
    slope = jax.grad(lambda pins: measure(pins, holes).sum())(far)
    assert np.isfinite(slope).all() and np.all(slope[0, :10] == 0)


def test_a_fresh_renderer_draws_nearly_the_untouched_pins():
    drawn = render_pins(*made(PinRenderer, 4), jnp.full((2, 4), 0.7))
    assert drawn.shape == (2, *REST.shape) and 0 < np.abs(drawn - REST[None]).max() < 1.0


def test_spoiling_adds_its_noise():
    pins = jnp.asarray(np.tile(REST, (400, 1, 1)))
    spoilt = add_noise(PinUnshear(**SMALL, noise_px=0.5), pins, jax.random.key(3))
    assert np.std(spoilt - pins) == pytest.approx(0.5, rel=0.05)


def test_both_decoders_draw_from_the_codes():
    net, variables = made(PinUnshear)
    decoded, _ = reconstruct(net, variables, moved())
    z_p, z_s = encode(net, variables, moved())
    np.testing.assert_array_equal(decoded.canonical, decode_canonical(net, variables, z_p))
    np.testing.assert_array_equal(decoded.sheared, decode_sheared(net, variables, z_p, z_s))
    assert decoded.counterfactual is None and decoded.disagreement is None


@pytest.mark.parametrize(
    ("separate_encoders", "untaught"), [(True, {"E", "pose", "ES", "shear", "DC"}), (False, {"DC"})]
)
def test_apart_the_sheared_pins_teach_no_code(separate_encoders, untaught):
    """By gradients that are exactly zero, of what was exchanged, too."""
    net, variables = made(PinUnshear, separate_encoders=separate_encoders)

    def draw(given):
        decoded, _ = reconstruct(net, given, moved(), jax.random.key(0), moved(2), moved(3))
        return decoded.sheared + decoded.counterfactual

    assert variables["params"].keys() - find_taught_parts(draw, variables) == untaught


def test_exchanged_codes_are_those_they_are_called():
    net, variables = made(PinUnshear, separate_encoders=True)
    own, same_pose, same_slide = moved(1), moved(2), moved(3)

    def exchange(*partners):
        return reconstruct(net, variables, own, None, *partners)[0]

    decoded = exchange(same_pose, same_slide)
    (z_p, _), (other, _), (_, z_s) = (
        encode(net, variables, pins) for pins in (own, same_pose, same_slide)
    )
    expected = decode_sheared(net, variables, z_p, z_s)
    np.testing.assert_allclose(decoded.counterfactual, expected, rtol=1e-5)
    expected = decode_canonical(net, variables, other)
    np.testing.assert_allclose(decoded.same_pose, expected, rtol=1e-5)
    assert np.all(decoded.disagreement > 0)
    assert np.all(exchange(own).disagreement == 0)
    assert np.all(exchange(own, own).disagreement == 0)


def test_disagreement_is_zero_of_equal_codes_and_depends_on_no_scale():
    one, other = jax.random.normal(jax.random.key(0), (2, 40, 3))
    assert np.all(measure_disagreement(one, one) == 0)
    plain = measure_disagreement(one, other)
    np.testing.assert_allclose(measure_disagreement(1e3 * one, 1e3 * other), plain, rtol=1e-3)
    mixed = jnp.array([[2.0, 1.0, 0.0], [0.0, 3.0, 1.0], [1.0, 0.0, 1.0]])
    np.testing.assert_allclose(measure_disagreement(one @ mixed, other @ mixed), plain, rtol=1e-2)
    assert float(plain.mean()) == pytest.approx(2, rel=0.15)  # unrelated codes


def test_a_difference_in_a_narrow_direction_costs_as_much_as_in_a_wide_one():
    """Half of the code's directions differ: in the wide ones, or in those of a hundredth of their deviation."""
    pose, slide = jax.random.normal(jax.random.key(1), (2, 500, 2))
    fresh = jax.random.normal(jax.random.key(2), (500, 2))
    wide = measure_disagreement(*(jnp.concatenate([s, 0.01 * pose], 1) for s in (slide, fresh)))
    narrow = measure_disagreement(*(jnp.concatenate([pose, 0.01 * s], 1) for s in (slide, fresh)))
    assert float(wide.mean()) == pytest.approx(1, rel=0.1)
    assert float(narrow.mean()) > 0.3


def hexagon(rings, spacing=7.0, middle=(64.0, 60.0)):
    steps = range(-rings, rings + 1)
    axial = np.array([(a, b) for a in steps for b in steps if abs(a + b) <= rings])
    return np.asarray(middle) + spacing * axial @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])


def places(rest, side):
    low, high = rest.min(axis=0), rest.max(axis=0)
    return np.stack(np.meshgrid(*np.linspace(low, high, side).T), -1).reshape(-1, 2)


@pytest.mark.parametrize("rings", [6, 10])  # 127 pins, and 331
def test_the_grid_is_as_fine_as_the_pins(rings):
    rest = hexagon(rings)
    grid = make_grid(rest)
    assert grid.shape == (len(rest), (2 * rings) ** 2) and grid.dtype == np.float32
    inside = grid.any(axis=0)
    assert 0.6 < inside.mean() < 0.9  # a hexagon's share of the square about it
    # a shift of all pins is that shift everywhere
    np.testing.assert_allclose(grid.sum(axis=0)[inside], 1, atol=1e-5)


def test_a_smooth_field_comes_out_at_its_places():
    rest = hexagon(10)
    at, grid = places(rest, 20), make_grid(rest)
    inside = grid.any(axis=0)

    def field(xy):
        return np.sin(xy[:, 0] / 30) + 0.02 * xy[:, 1]

    error = np.abs(field(rest) @ grid - field(at))[inside]
    # others are beyond the last pins
    beside = np.linalg.norm(at[inside][:, None] - rest, axis=-1).min(axis=1) < 0.6 * 7.0
    assert error[beside].max() < 0.04 and error.max() < 0.2


@pytest.mark.parametrize("changes", [{}, {"conv_channels": (4, 6), "separate_encoders": True}])
def test_a_network_of_several_tasks_folds_into_one_of_a_task(changes):
    net = PinUnshear(**SMALL | changes)
    unknown = jnp.full(3, 1 / 3)
    variables = init(net, REST, 1.5, jax.random.key(0), tasks=unknown)
    pins, second = moved(), jnp.array([0.0, 1.0, 0.0])
    given = unshear(net, give_tasks(variables, jnp.tile(second, (3, 1))), pins)
    folded = fold_tasks(variables, second)
    np.testing.assert_allclose(unshear(net, folded, pins), given, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(
        unshear(net, fold_tasks(variables), pins),
        unshear(net, variables, pins),
        rtol=1e-5,
        atol=1e-4,
    )
    assert np.abs(given - unshear(net, variables, pins)).max() > 1e-3
    alone = init(net, REST, 1.5, jax.random.key(0))
    assert jax.tree.map(jnp.shape, folded) == jax.tree.map(jnp.shape, alone)
    unfolded = unfold_tasks(folded, 3)
    assert jax.tree.map(jnp.shape, unfolded) == jax.tree.map(jnp.shape, variables)
    again = unshear(net, give_tasks(unfolded, jnp.eye(3)), pins)
    np.testing.assert_allclose(again, given, rtol=1e-5, atol=1e-4)


def test_each_contact_of_a_batch_is_of_its_own_task():
    net = PinUnshear(**SMALL, conv_channels=(4, 6))
    variables = init(net, REST, 1.5, jax.random.key(0), tasks=jnp.full(3, 1 / 3))
    shares, pins = jnp.eye(3), moved()
    together = unshear(net, give_tasks(variables, shares), pins)
    for i in range(3):
        alone = unshear(net, fold_tasks(variables, shares[i]), pins[i : i + 1])[0]
        np.testing.assert_allclose(together[i], alone, rtol=1e-5, atol=1e-4)
