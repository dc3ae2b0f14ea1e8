"""What can be said of a sheared image without a network that unshears: pure functions of images (B, S, S, 1) in [0, 1].

>>> make_baseline_images(collect_training_taps(batches), tap, sheared)["nearest_tap"]
"""

from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.selection import select_evenly

MAX_TAPS = 2000  # of the training split are searched, evenly chosen
MAX_SHIFT = 0.25  # of the image's side: how far a translation may go


def collect_training_taps(batches: Iterable[Mapping[str, np.ndarray]]) -> np.ndarray:
    """One tap of every pose, at most MOST_TAPS of them: (M, S, S, 1) uint8. Batches hold canonical, stimulus and pose_id."""
    taps: dict[tuple[int, int], np.ndarray] = {}
    for batch in batches:
        for stimulus, pose, tap in zip(
            batch["stimulus"], batch["pose_id"], batch["canonical"], strict=True
        ):
            taps.setdefault((int(stimulus), int(pose)), tap)
    every = list(taps.values())
    return np.stack([every[index] for index in select_evenly(len(every), MAX_TAPS)])


def make_baseline_images(taps: Array, tap: Array, sheared: Array) -> dict[str, Array]:
    """By name of `score.BASELINES`; taps (M, S, S, 1) uint8 of the training split. Only "translated" uses the tap."""
    known = taps.astype(sheared.dtype) / 255
    return {
        "mean_tap": jnp.broadcast_to(known.mean(0), sheared.shape),
        "nearest_tap": find_nearest_images(known, sheared),
        "translated": jax.vmap(translate_to_target)(sheared, tap),
    }


def find_nearest_images(candidates: Array, images: Array) -> Array:
    """For every image that of `candidates` (M, S, S, 1) which differs least from it, by mean squared difference."""
    flat, rows = (x.reshape(len(x), -1) for x in (candidates, images))
    away = jnp.sum(flat**2, 1) - 2 * jnp.matmul(
        rows, flat.T, precision="highest"
    )  # up to the image's own square
    return candidates[jnp.argmin(away, 1)]


def translate_to_target(image: Array, target: Array) -> Array:
    """`image` (S, S, 1) moved by the integer shift, at most REACH of its side, that brings it nearest to `target` in mean squared
    difference; black flows in. No translation can do better: this one knows the answer."""
    size = image.shape[0]
    most = int(MAX_SHIFT * size)
    shape = (2 * size, 2 * size)

    def correlate(a: Array, b: Array) -> Array:
        """sum over x of a(x) b(x + shift), by shift from -most to most on each axis."""
        product = jnp.fft.irfft2(jnp.conj(jnp.fft.rfft2(a, shape)) * jnp.fft.rfft2(b, shape), shape)
        return jnp.roll(product, (most, most), (0, 1))[: 2 * most + 1, : 2 * most + 1]

    plain, wanted = image[..., 0], target[..., 0]
    in_view = correlate(plain**2, jnp.ones_like(plain))
    best = jnp.argmin(in_view - 2 * correlate(plain, wanted))
    rows, columns = jnp.divmod(best, 2 * most + 1)
    # moved by (rows - most, columns - most)
    framed = jnp.pad(plain, most)
    return jax.lax.dynamic_slice(framed, (2 * most - rows, 2 * most - columns), (size, size))[
        ..., None
    ]
