"""Muon: equal to optax's, near-orthogonal, exact zeros, and a training with it goes on bit for bit."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxunshear.config.networks import UnshearNet
from jaxunshear.training.step import muon, orthogonalise

sys.path.insert(0, str(Path(__file__).parent))

NET = UnshearNet(size=16, widths=(8, 16), pose_channels=8, shear_channels=8)
SHAPES = {  # as of a small network: first, inner and last layers, and a dense one
    "First": {"kernel": (4, 4, 1, 8)},
    "Down": {"kernel": (4, 4, 8, 16), "norm": {"scale": (16,), "bias": (16,)}},
    "Same": {"kernel": (3, 3, 16, 12)},
    "Up": {"kernel": (4, 4, 12, 8)},
    "Last": {"kernel": (4, 4, 8, 1), "bias": (1,)},
    "Dense": {"kernel": (20, 9), "bias": (9,)},
    "ReadOut": {"kernel": (9, 5), "bias": (5,)},
}
INNER = ("Down.kernel", "Same.kernel", "Up.kernel", "Dense.kernel")


@pytest.fixture
def params():
    return noise_like(
        jax.tree.map(np.zeros, SHAPES, is_leaf=lambda shape: isinstance(shape, tuple)), 99
    )


def noise_like(params, seed):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), params)


def named(params):
    return {
        ".".join(key.key for key in path): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(params)
    }


def is_inner(name):
    return name in INNER


@pytest.mark.parametrize("shape", [(40, 12), (12, 40), (16, 16), (1, 9)])
@pytest.mark.parametrize("jit", [False, True])
def test_orthogonal_is_the_quintic_of_the_singular_values(shape, jit):
    x = np.random.default_rng(1).normal(size=shape)
    u, s, v = np.linalg.svd(x, full_matrices=False)
    s = s / np.linalg.norm(s)
    for _ in range(5):
        s = 3.4445 * s - 4.7750 * s**3 + 2.0315 * s**5
    got = (jax.jit(orthogonalise) if jit else orthogonalise)(jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(
        got, u * s @ v, atol=1e-4
    )  # of entries near 0.3; tiny singular values are lost first


def test_orthogonal_brings_singular_values_near_one():
    x = np.random.default_rng(2).normal(size=(300, 20)) @ np.diag(np.geomspace(1, 0.02, 20))
    s = np.linalg.svd(np.asarray(orthogonalise(jnp.asarray(x, jnp.float32))), compute_uv=False)
    assert s.min() > 0.6 and s.max() < 1.25


@pytest.mark.parametrize("scale", [1e-30, 1e-4, 1e4, 1e15])
def test_orthogonal_is_finite_at_any_scale(scale):
    x = jnp.asarray(np.random.default_rng(3).normal(size=(30, 5)) * scale, jnp.float32)
    assert jnp.isfinite(orthogonalise(x)).all()


def test_orthogonal_of_low_rank_and_of_nothing():
    x = jnp.outer(jnp.arange(1.0, 31.0), jnp.ones(8))
    assert np.linalg.matrix_rank(np.asarray(orthogonalise(x)), tol=1e-3) == 1
    assert (orthogonalise(jnp.zeros((30, 8))) == 0).all()


def test_updates_of_inner_kernels_are_jordan_s(params):
    """Nesterov's momentum, and the singular values of its matrix by the quintic: of his reference implementation."""
    ours = muon(1.0, 0.5, 0.999)
    state, update_of = ours.init(params), jax.jit(ours.update)
    momentum = {name: np.zeros(leaf.shape) for name, leaf in named(params).items()}
    for seed in range(3):
        gradient = noise_like(params, seed)
        got, state = update_of(gradient, state, params)
        for name, update in filter(lambda item: is_inner(item[0]), named(got).items()):
            g = np.asarray(named(gradient)[name], np.float64)
            momentum[name] = 0.95 * momentum[name] + 0.05 * g
            matrix = (0.05 * g + 0.95 * momentum[name]).reshape(-1, g.shape[-1])
            u, s, v = np.linalg.svd(matrix, full_matrices=False)
            s = s / np.linalg.norm(s)
            for _ in range(5):
                s = 3.4445 * s - 4.7750 * s**3 + 2.0315 * s**5
            expected = -0.2 * np.sqrt(max(matrix.shape)) * (u * s @ v)
            np.testing.assert_allclose(update, expected.reshape(g.shape), atol=2e-3, err_msg=name)


def test_optax_s_updates_of_inner_kernels_are_the_same_but_for_the_start(params):
    axes = {
        name: optax.contrib.MuonDimensionNumbers(tuple(range(leaf.ndim - 1)), leaf.ndim - 1)
        if is_inner(name)
        else None
        for name, leaf in named(params).items()
    }
    theirs = optax.contrib.muon(1.0, consistent_rms=0.2, muon_weight_dimension_numbers=axes)
    ours = muon(1.0, 0.5, 0.999)
    states = theirs.init(named(params)), ours.init(params)
    their_update, our_update = jax.jit(theirs.update), jax.jit(ours.update)
    off = []
    for seed in range(100):
        gradient = noise_like(params, seed)
        expected, other = their_update(named(gradient), states[0], named(params))
        got, mine = our_update(gradient, states[1], params)
        states = other, mine
        pairs = [(named(got)[name], expected[name]) for name in INNER]
        off.append(max(float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b)) for a, b in pairs))
    assert off[0] < 1e-4 and 0.02 < off[1] < 0.2 and off[-1] < 1e-3


def test_first_and_last_layers_and_vectors_are_adam_s(params):
    ours, adam = muon(3e-3, 0.5, 0.999), optax.adam(3e-3, 0.5, 0.999)
    states = ours.init(params), adam.init(params)
    for seed in range(3):
        gradient = noise_like(params, seed)
        got, mine = ours.update(gradient, states[0], params)
        expected, other = adam.update(gradient, states[1], params)
        states = mine, other
    for name, update in named(got).items():
        assert jnp.array_equal(update, named(expected)[name]) != is_inner(name), name


def test_updates_are_about_as_large_as_adam_s(params):
    ours, adam = muon(1.0, 0.9, 0.999), optax.adam(1.0, 0.9, 0.999)
    states = (ours.init(params), adam.init(params))
    our_update = jax.jit(ours.update)
    adams_update = jax.jit(adam.update)
    for seed in range(20):
        gradient = noise_like(params, seed)
        got, mine = our_update(gradient, states[0], params)
        expected, other = adams_update(gradient, states[1], params)
        states = mine, other
    for name in filter(is_inner, named(got)):
        ratio = jnp.sqrt(jnp.mean(named(got)[name] ** 2) / jnp.mean(named(expected)[name] ** 2))
        assert 0.4 < ratio < 2.5, (name, ratio)
