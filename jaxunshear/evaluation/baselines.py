"""Baselines: unshear images (B, S, S, 1) in [0, 1] without a network.

>>> make_baseline_images(collect_training_taps(batches), tap, sheared)["nearest_tap"]
"""

from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.selection import select_evenly

MAX_TAPS = 2000  # of the training split, evenly chosen
MAX_SHIFT = 0.25  # of a translation, in sides of the image


def collect_training_taps(batches: Iterable[Mapping[str, np.ndarray]]) -> np.ndarray:
    """Collect one tap of every pose, at most MAX_TAPS: (M, S, S, 1) uint8.

    Batches hold canonical, stimulus and pose_id.
    """
    tap_by_pose: dict[tuple[int, int], np.ndarray] = {}
    for batch in batches:
        for stimulus, pose, tap in zip(
            batch["stimulus"], batch["pose_id"], batch["canonical"], strict=True
        ):
            tap_by_pose.setdefault((int(stimulus), int(pose)), tap)
    taps = list(tap_by_pose.values())
    return np.stack([taps[index] for index in select_evenly(len(taps), MAX_TAPS)])


def make_baseline_images(taps: Array, tap: Array, sheared: Array) -> dict[str, Array]:
    """Make the images of `score.BASELINES` by name.

    `taps` (M, S, S, 1) uint8 are of the training split. Only "translated" uses `tap`.
    """
    training_taps = taps.astype(sheared.dtype) / 255
    return {
        "mean_tap": jnp.broadcast_to(training_taps.mean(0), sheared.shape),
        "nearest_tap": find_nearest_images(training_taps, sheared),
        "translated": jax.vmap(translate_to_target)(sheared, tap),
    }


def find_nearest_images(candidates: Array, images: Array) -> Array:
    """Find for every image that of `candidates` (M, S, S, 1) with the least mean squared error."""
    flat, rows = candidates.reshape(len(candidates), -1), images.reshape(len(images), -1)
    products = jnp.matmul(rows, flat.T, precision="highest")
    distances = jnp.sum(flat**2, 1) - 2 * products  # without the square of the image, a constant
    return candidates[jnp.argmin(distances, 1)]


def translate_to_target(image: Array, target: Array) -> Array:
    """Translate `image` (S, S, 1) by the pixels that bring it nearest to `target`.

    The shift is at most MAX_SHIFT of the side, nearness is the mean squared difference, and black
    flows in. No translation can do better, since this one uses the answer.
    """
    size = image.shape[0]
    most = int(MAX_SHIFT * size)
    shape = (2 * size, 2 * size)

    def correlate(a: Array, b: Array) -> Array:
        """Sum a(x) b(x + shift) over x, for shifts from -most to most on each axis."""
        product = jnp.fft.irfft2(jnp.conj(jnp.fft.rfft2(a, shape)) * jnp.fft.rfft2(b, shape), shape)
        return jnp.roll(product, (most, most), (0, 1))[: 2 * most + 1, : 2 * most + 1]

    plain = image[..., 0]
    in_view = correlate(plain**2, jnp.ones_like(plain))
    best = jnp.argmin(in_view - 2 * correlate(plain, target[..., 0]))
    rows, columns = jnp.divmod(best, 2 * most + 1)
    # the shift is (rows - most, columns - most)
    start = (2 * most - rows, 2 * most - columns)
    return jax.lax.dynamic_slice(jnp.pad(plain, most), start, (size, size))[..., None]
