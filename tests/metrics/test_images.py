"""MS-SSIM, SSIM and MSE: an independent library, known answers, and powers near zero."""

import json
import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.metrics import images

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
MADE = runpy.run_path(str(GOLDEN / "make_ms_ssim.py"))
VALUES = json.loads((GOLDEN / "ms_ssim.json").read_text())
RANDOM = json.loads((GOLDEN / "ms_ssim_random.json").read_text())


def stacked(size):
    pairs = MADE["pairs"](size)
    return list(pairs), *np.stack(list(pairs.values()), axis=1)[..., None]


def ms_ssim(scales):
    return lambda a, b: images.ms_ssim(a, b, scales)


METRICS = pytest.mark.parametrize("metric", ["ms_ssim", "ssim"])


@METRICS
def test_golden_values(metric):
    names, a, b = stacked(256)
    found = np.asarray(getattr(images, metric)(a, b))
    assert found.dtype == np.float32
    expected = [VALUES[name][metric] for name in names]
    np.testing.assert_allclose(found, expected, atol=1e-4, err_msg=str(names))


@pytest.fixture(scope="module")
def random_pairs():
    return [images[..., None] for images in MADE["random_pairs"]()]


@METRICS
def test_a_hundred_random_pairs_score_as_stored(metric, random_pairs):
    found = np.asarray(getattr(images, metric)(*random_pairs))
    np.testing.assert_allclose(found, RANDOM[metric], atol=1e-4)
    assert len(found) == 100 and min(RANDOM[metric]) < 0.1 and max(RANDOM[metric]) > 0.9


@METRICS
def test_a_hundred_random_pairs_score_as_in_the_other_library(metric, random_pairs):
    """Values, and gradients of the first twenty if the score is not clamped. Ours are finite."""
    torch = pytest.importorskip("torch", reason="the extra `torch` is not installed")
    theirs = pytest.importorskip("pytorch_msssim", reason="pip install pytorch-msssim")
    ours, score = getattr(images, metric), getattr(theirs, metric)
    a, b = random_pairs
    values, slopes = jax.vjp(lambda x: ours(x, b), jnp.asarray(a))
    values, slopes = np.asarray(values), np.asarray(slopes(jnp.ones_like(values))[0])
    assert np.isfinite(slopes).all()
    given, other = (torch.from_numpy(side.transpose(0, 3, 1, 2).copy()) for side in (a, b))
    parts = zip(given.split(20), other.split(20), strict=True)
    with torch.no_grad():
        expected = torch.cat([score(*part, 1.0, False) for part in parts])
    np.testing.assert_allclose(values, expected.numpy(), atol=1e-4)
    given = given[:20].requires_grad_()
    score(given, other[:20], 1.0, False).sum().backward()
    free = values[:20] > 0.01  # nearer to zero the slopes of powers magnify rounding
    mine, its = slopes[:20, ..., 0][free], given.grad.numpy()[:, 0][free]
    apart, size = (np.linalg.norm(x, axis=(1, 2)) for x in (mine - its, mine))
    assert (apart < 1e-2 * size).all() and free.sum() >= 15


@pytest.mark.parametrize("metric", [ms_ssim(2), images.ssim, images.mse])
def test_a_nan_is_not_hidden(metric):
    """Nor does it reach the other images."""
    _, a, b = stacked(48)
    spoilt = a.copy()
    spoilt[1, 20, 30] = np.nan
    for found, clean in ((metric(spoilt, b), metric(a, b)), (metric(b, spoilt), metric(b, a))):
        assert np.isnan(found[1])
        np.testing.assert_array_equal(np.delete(found, 1), np.delete(clean, 1))


def test_jit_and_eager_agree():
    _, a, b = stacked(48)
    with jax.disable_jit():
        plain = images.ms_ssim(a, b, scales=2)
    np.testing.assert_allclose(jax.jit(images.ms_ssim, static_argnums=2)(a, b, 2), plain, atol=2e-5)


@pytest.mark.parametrize(
    ("size", "scales"), [(10, 0), (11, 1), (128, 4), (160, 4), (161, 5), (256, 5), (1000, 5)]
)
def test_scales_that_fit(size, scales):
    assert images.count_scales(size) == scales
    assert images.format_ms_ssim_name(scales) == ("ms_ssim" if scales == 5 else f"ms_ssim@{scales}")


def test_the_least_size_of_five_scales_works_and_one_less_is_refused():
    white = np.ones((1, 161, 161, 1), np.float32)
    assert images.ms_ssim(white, white)[0] == 1
    less = white[:, 1:, 1:]
    with pytest.raises(ValueError, match=r"160x160.*5 scales.*4 fit"):
        images.ms_ssim(less, less)
    for scales in (0, 6):
        with pytest.raises(ValueError, match="must be 1 to 5"):
            images.ms_ssim(white, white, scales)


@pytest.mark.parametrize("size", [128, 161])
def test_equal_images_score_one_and_order_does_not_matter(size):
    _, a, b = stacked(size)
    score = ms_ssim(images.count_scales(size))
    np.testing.assert_allclose(score(a, a), 1, atol=1e-5)
    np.testing.assert_allclose(score(a, b), score(b, a), atol=1e-5)
    one_scale = np.maximum(images.ssim(a, b), 0)
    np.testing.assert_allclose(images.ms_ssim(a, b, scales=1), one_scale, atol=1e-6)


@pytest.mark.parametrize("metric", [ms_ssim(3), images.ssim, images.mse])
def test_values_and_gradients_are_finite_everywhere(metric):
    names, a, b = stacked(64)
    black, white = np.zeros_like(a[:1]), np.ones_like(a[:1])
    a, b = np.concatenate([a, black, white, black]), np.concatenate([b, black, white, white])
    total = jax.value_and_grad(lambda x: jnp.sum(metric(x, b)))
    values, gradients = jax.jit(total)(jnp.asarray(a))
    assert np.isfinite(values) and np.isfinite(gradients).all(), names


def test_gradient_is_the_slope():
    _, a, b = (each[2:3] for each in stacked(48))
    direction = np.cos(np.arange(48 * 48)).reshape(a.shape).astype(np.float32)
    above, below = (
        images.ms_ssim(a + step * direction, b, 2)[0] for step in np.float32([1e-2, -1e-2])
    )
    gradient = jax.grad(lambda x: images.ms_ssim(x, b, 2)[0])(jnp.asarray(a))
    slope = float(np.sum(np.asarray(gradient) * direction))
    assert slope == pytest.approx(float(above - below) / 2e-2, rel=0.03)


def test_mse_known_answer():
    a = np.zeros((2, 12, 12, 1), np.float32)
    b = np.stack([np.full((12, 12, 1), 0.5), np.ones((12, 12, 1))]).astype(np.float32)
    np.testing.assert_allclose(images.mse(a, b), [0.25, 1.0])


@pytest.mark.parametrize("metric", [images.ms_ssim, images.ssim, images.mse])
def test_wrong_images_are_refused(metric):
    good = np.zeros((2, 256, 256, 1), np.float32)
    with pytest.raises(ValueError, match="one shape"):
        metric(good, good[:1])
    with pytest.raises(ValueError, match="one shape"):
        metric(good[..., 0], good[..., 0])
    with pytest.raises(ValueError, match="uint8"):
        metric(good, good.astype(np.uint8))


def test_half_precision_is_scored_in_float32():
    _, a, b = stacked(48)
    found = images.ms_ssim(jnp.asarray(a, jnp.bfloat16), jnp.asarray(b, jnp.bfloat16), 2)
    assert found.dtype == jnp.float32
    # dots are exact in bfloat16
    np.testing.assert_allclose(found[1:4], images.ms_ssim(a, b, 2)[1:4], atol=1e-5)


@pytest.mark.parametrize("metric", [images.ms_ssim, images.ssim])
def test_no_pair_is_more_alike_than_equal_ones(metric):
    """Nearly flat images, bright ones above all, and images of two flat halves."""
    rng, each = np.random.default_rng(0), (60, 1, 1, 1)
    noise = rng.normal(size=(2, 60, 192, 192, 1)) * 10.0 ** rng.uniform(-6, -2, each)
    level = np.where(np.arange(192)[:, None, None] < 96, 0.3, 1.0) ** rng.integers(0, 2, each)
    a, b = (level * rng.uniform(0.9, 1, each) + noise).astype(np.float32)
    found = np.asarray(metric(a, b))
    assert found.max() <= 1 and found.min() > 0.5
    if metric is images.ssim:
        pairs = zip(np.float64(a[:9, ..., 0]), np.float64(b[:9, ..., 0]), strict=True)
        np.testing.assert_allclose(found[:9], [_exact_ssim(*pair) for pair in pairs], atol=1e-4)


def _exact_ssim(a, b):
    """By the formula as it is printed, in float64."""
    blur = lambda x: images._make_blur(192) @ x @ images._make_blur(192).T  # noqa: E731
    mean_a, mean_b = blur(a), blur(b)
    variances = blur(a * a) - mean_a**2 + blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + images.C1) / (mean_a**2 + mean_b**2 + images.C1)
    return np.mean(luminance * (2 * covariance + images.C2) / (variances + images.C2))
