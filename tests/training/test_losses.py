"""Losses against their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.models import distances
from jaxunshear.training import losses


@pytest.fixture(scope="module")
def pair():
    rng = np.random.default_rng(0)
    return [jnp.asarray(rng.uniform(size=(3, 24, 24, 1)), jnp.float32) for _ in range(2)]


def test_patch_loss_is_the_mean_over_explicit_crops(pair):
    a, b = pair
    corners = distances.sample_corners(jax.random.key(0), 3, 40, 24, 7)
    got = distances.compute_patch_loss(a, b, distances.count_crop_coverage(corners, 24, 7))
    assert got.shape == (3,)
    for image in range(3):
        crops = [np.abs(a - b)[image, r : r + 7, c : c + 7] for r, c in np.asarray(corners[image])]
        assert all(crop.shape == (7, 7, 1) for crop in crops)
        np.testing.assert_allclose(got[image], np.mean(crops), rtol=1e-5)


def test_crops_reach_every_place_that_fits_and_no_other():
    corners = distances.sample_corners(jax.random.key(1), 2, 5000, 24, 20)
    for axis in (0, 1):
        assert set(np.asarray(corners[..., axis]).ravel()) == set(range(5))
    np.testing.assert_array_equal(
        distances.count_crop_coverage(corners, 24, 20).sum((1, 2)), 5000 * 400
    )


def test_one_crop_of_the_full_image_is_the_mean_difference(pair):
    a, b = pair
    counts = distances.count_crop_coverage(jnp.zeros((3, 1, 2), jnp.int32), 24, 24)
    np.testing.assert_allclose(
        distances.compute_patch_loss(a, b, counts), np.abs(a - b).mean((1, 2, 3)), rtol=1e-5
    )


def test_squared_losses(pair):
    a, b = pair
    expected = ((np.asarray(a) - np.asarray(b)) ** 2).mean((1, 2, 3))
    np.testing.assert_allclose(distances.compute_supervised_loss(a, b), expected, rtol=1e-5)
    np.testing.assert_allclose(distances.compute_supervised_loss(a, a), 0)
    np.testing.assert_allclose(
        distances.compute_pose_loss(jnp.ones((2, 5)), jnp.zeros((2, 5)), (1.0, 1.0, 4.0, 1.0, 1.0)),
        1.6,
    )


def test_regularisation_takes_kernels_only():
    params = {
        "E": {"kernel": jnp.array([1.0, -2.0]), "bias": jnp.array([9.0])},
        "norm": {"scale": jnp.array([7.0])},
    }
    np.testing.assert_allclose(losses.compute_regularisation(params, 0.5, 0.0), 1.5)
    np.testing.assert_allclose(losses.compute_regularisation(params, 0.0, 0.1), 0.5)


def test_regularisation_over_a_kernels_mean_does_not_grow_with_its_size():
    """Both kernels count |w| = 0.02 and w^2 = 0.0004 once, however many weights they have."""
    params = {
        name: {"kernel": jnp.full(shape, -0.02)}
        for name, shape in (("a", (4, 4, 64, 64)), ("b", (3, 2)))
    }
    np.testing.assert_allclose(
        losses.compute_regularisation(params, 0.5, 0.0, "mean"), 2 * 0.5 * 0.02, rtol=1e-5
    )
    np.testing.assert_allclose(
        losses.compute_regularisation(params, 0.0, 0.1, "mean"), 2 * 0.1 * 0.0004, rtol=1e-5
    )
    np.testing.assert_allclose(
        losses.compute_regularisation(params, 0.5, 0.0), 0.5 * 0.02 * (65536 + 6), rtol=1e-4
    )


@pytest.mark.parametrize(("kernels", "slope"), [("sum", 1e-3), ("mean", 1e-3 / 24)])
def test_the_slope_of_l1_is_the_same_for_every_weight(kernels, slope):
    kernel = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 4)), jnp.float32)
    found = jax.grad(
        lambda w: losses.compute_regularisation({"a": {"kernel": w}}, 1e-3, 0.0, kernels)
    )(kernel)
    np.testing.assert_allclose(found, slope * np.sign(kernel), rtol=1e-5)


def test_sizes_of_kernels_are_roots_of_mean_squares():
    params = {
        "E": {
            "Down_0": {"kernel": jnp.array([[3.0, -4.0]]), "bias": jnp.array([9.0])},
            "scale": jnp.ones(2),
        }
    }
    sizes = losses.measure_kernel_sizes(params)
    assert list(sizes) == ["E.Down_0"]
    np.testing.assert_allclose(sizes["E.Down_0"], np.sqrt(12.5), rtol=1e-6)
