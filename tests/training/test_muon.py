"""Muon: equal to optax's, near-orthogonal, exact zeros, and a training with it goes on bit for bit."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxunshear.training.muon import muon, orthogonalise

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
    shapes = jax.tree.map(np.zeros, SHAPES, is_leaf=lambda shape: isinstance(shape, tuple))
    return noise_like(shapes, 99)


def noise_like(params, seed):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), params)


def join_keys(path):
    return ".".join(key.key for key in path)


def named(params):
    return {join_keys(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(params)}


def apply_quintic(matrix):
    """Return the matrix with its singular values put through Jordan's quintic five times."""
    u, s, v = np.linalg.svd(matrix, full_matrices=False)
    s = s / np.linalg.norm(s)
    for _ in range(5):
        s = 3.4445 * s - 4.7750 * s**3 + 2.0315 * s**5
    return u * s @ v


def follow(optimisers, params, steps):
    """Yield a gradient and each optimiser's updates for it, by name, step by step."""
    states = [each.init(params) for each in optimisers]
    updates = [jax.jit(each.update) for each in optimisers]
    for seed in range(steps):
        gradient = noise_like(params, seed)
        found = [
            update(gradient, state, params) for update, state in zip(updates, states, strict=True)
        ]
        states = [state for _, state in found]
        yield named(gradient), *(named(update) for update, _ in found)


@pytest.mark.parametrize("shape", [(40, 12), (12, 40), (16, 16), (1, 9)])
@pytest.mark.parametrize("jit", [False, True])
def test_orthogonal_is_the_quintic_of_the_singular_values(shape, jit):
    x = np.random.default_rng(1).normal(size=shape)
    got = (jax.jit(orthogonalise) if jit else orthogonalise)(jnp.asarray(x, jnp.float32))
    # of entries near 0.3; tiny singular values are lost first
    np.testing.assert_allclose(got, apply_quintic(x), atol=1e-4)


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
    momentum = {name: np.zeros(leaf.shape) for name, leaf in named(params).items()}
    for gradient, got in follow([muon(1.0, 0.5)], params, 3):
        for name in INNER:
            g = np.asarray(gradient[name], np.float64)
            momentum[name] = 0.95 * momentum[name] + 0.05 * g
            matrix = (0.05 * g + 0.95 * momentum[name]).reshape(-1, g.shape[-1])
            expected = -0.2 * np.sqrt(max(matrix.shape)) * apply_quintic(matrix).reshape(g.shape)
            np.testing.assert_allclose(got[name], expected, atol=2e-3, err_msg=name)


def test_optax_s_updates_of_inner_kernels_are_the_same_but_for_the_start(params):
    def list_axes(path, leaf):
        axes = optax.contrib.MuonDimensionNumbers(tuple(range(leaf.ndim - 1)), leaf.ndim - 1)
        return axes if join_keys(path) in INNER else None

    axes = jax.tree_util.tree_map_with_path(list_axes, params)
    theirs = optax.contrib.muon(1.0, consistent_rms=0.2, muon_weight_dimension_numbers=axes)
    off = []
    for _, got, expected in follow([muon(1.0, 0.5), theirs], params, 100):
        pairs = [(got[name], expected[name]) for name in INNER]
        off.append(max(float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b)) for a, b in pairs))
    assert off[0] < 1e-4 and 0.02 < off[1] < 0.2 and off[-1] < 1e-3


def test_first_and_last_layers_and_vectors_are_adam_s(params):
    optimisers = muon(3e-3, 0.5), optax.adam(3e-3, 0.5)
    *_, (_, got, expected) = follow(optimisers, params, 3)
    for name, update in got.items():
        assert jnp.array_equal(update, expected[name]) != (name in INNER), name


def test_updates_are_about_as_large_as_adam_s(params):
    optimisers = muon(1.0, 0.9), optax.adam(1.0, 0.9)
    *_, (_, got, expected) = follow(optimisers, params, 20)
    for name in INNER:
        ratio = jnp.sqrt(jnp.mean(got[name] ** 2) / jnp.mean(expected[name] ** 2))
        assert 0.4 < ratio < 2.5, (name, ratio)
