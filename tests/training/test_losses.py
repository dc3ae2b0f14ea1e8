"""Losses against their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.models import distances
from jaxunshear.training import step


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
    counts = distances.count_crop_coverage(corners, 24, 20)
    np.testing.assert_array_equal(counts.sum((1, 2)), 5000 * 400)


def test_one_crop_of_the_full_image_is_the_mean_difference(pair):
    a, b = pair
    counts = distances.count_crop_coverage(jnp.zeros((3, 1, 2), jnp.int32), 24, 24)
    found = distances.compute_patch_loss(a, b, counts)
    np.testing.assert_allclose(found, np.abs(a - b).mean((1, 2, 3)), rtol=1e-5)


def test_squared_losses(pair):
    a, b = pair
    expected = ((np.asarray(a) - np.asarray(b)) ** 2).mean((1, 2, 3))
    np.testing.assert_allclose(distances.compute_supervised_loss(a, b), expected, rtol=1e-5)
    np.testing.assert_allclose(distances.compute_supervised_loss(a, a), 0)
    weights = (1.0, 1.0, 4.0, 1.0, 1.0)
    found = distances.compute_pose_loss(jnp.ones((2, 5)), jnp.zeros((2, 5)), weights)
    np.testing.assert_allclose(found, 1.6)


PARAMS = {
    "E": {"kernel": jnp.array([3.0, -4.0]), "bias": jnp.array([9.0])},
    "norm": {"scale": jnp.array([7.0])},
    "wide": {"kernel": jnp.full((4, 4, 64, 64), -0.02)},
}


@pytest.mark.parametrize(
    ("l1", "l2", "kernels", "expected"),
    [
        (0.5, 0.0, "sum", 0.5 * (7 + 65536 * 0.02)),
        (0.0, 0.1, "sum", 0.1 * (25 + 65536 * 0.0004)),
        (0.5, 0.0, "mean", 0.5 * (3.5 + 0.02)),  # does not grow with the size of a kernel
        (0.0, 0.1, "mean", 0.1 * (12.5 + 0.0004)),
    ],
)
def test_regularisation_takes_kernels_only_by_their_sum_or_mean(l1, l2, kernels, expected):
    found = step.compute_regularisation(PARAMS, l1, l2, kernels)
    assert float(found) == pytest.approx(expected, rel=1e-4)


def test_sizes_of_kernels_are_roots_of_mean_squares():
    sizes = step.measure_kernel_sizes(PARAMS)
    assert sizes == {"E": pytest.approx(12.5**0.5), "wide": pytest.approx(0.02, rel=1e-5)}


@pytest.mark.parametrize(("kernels", "slope"), [("sum", 1e-3), ("mean", 1e-3 / 24)])
def test_the_slope_of_l1_is_the_same_for_every_weight(kernels, slope):
    kernel = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 4)), jnp.float32)
    found = jax.grad(
        lambda w: step.compute_regularisation({"a": {"kernel": w}}, 1e-3, 0.0, kernels)
    )(kernel)
    np.testing.assert_allclose(found, slope * np.sign(kernel), rtol=1e-5)
