"""How far outputs are from what they should be, for each example: the terms of losses.

One sum of the paper's terms (section 3.3) gives every module the gradient that the paper lists for
it: E sees all terms, DC L_sup and L_patch, DS L_rec, since no other path leads from a term to a
module.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxunshear.models.weights import Images, Outputs, PerExample, Pins, Variables


def compute_supervised_loss(canonical: Images, target: Images) -> PerExample:
    """Compute the mean squared difference of images in [0, 1], for L_sup and L_rec."""
    return jnp.mean((canonical - target) ** 2, (1, 2, 3))


def compute_pin_distance(pins: Pins, target: Pins, variables: Variables) -> PerExample:
    """Compute the mean squared distance of pins in units of `spread`; missing ones do not count."""
    is_present = jnp.isfinite(target)
    difference = pins - jnp.where(is_present, target, 0)
    square = jnp.where(is_present, jnp.square(difference / variables["batch_stats"]["spread"]), 0)
    return square.sum((1, 2)) / jnp.maximum(is_present.sum((1, 2), dtype=square.dtype), 1)


def compute_patch_loss(
    canonical: Images, target: Images, counts: Float[Array, "B S S"]
) -> PerExample:
    """Compute L_patch, the mean absolute difference over all pixels of all crops.

    `counts` are the numbers of crops that cover each pixel.
    """
    difference = jnp.abs(canonical - target)[..., 0]
    return jnp.sum(counts * difference, (1, 2)) / jnp.sum(counts, (1, 2))


def count_crop_coverage(
    corners: Int[Array, "B crops 2"], size: int, side: int
) -> Float[Array, "B {size} {size}"]:
    """Count the crops of `side` pixels that cover each pixel, from their corners (row, column).

    A crop is the outer product of an indicator of its rows and one of its columns, so the counts
    are one matrix product and the crops themselves are never cut out.
    """
    start = corners[..., None]
    pixel = jnp.arange(size)[None, None, None]
    rows, columns = jnp.moveaxis(
        ((pixel >= start) & (pixel < start + side)).astype(jnp.float32), 2, 0
    )
    return jnp.einsum("bkr,bkc->brc", rows, columns, precision="highest")


def sample_corners(
    key: Array, images: int, crops: int, size: int, side: int
) -> Int[Array, "{images} {crops} 2"]:
    """Sample the upper left corners of crops that lie in the image, uniformly."""
    return jax.random.randint(key, (images, crops, 2), 0, size - side + 1)


def compute_pose_loss(outputs: Outputs, targets: Outputs, weights: tuple[float, ...]) -> PerExample:
    """Compute PoseNet's L2 loss, the weighted mean squared difference of outputs and targets."""
    return jnp.mean(jnp.asarray([weights], outputs.dtype) * (outputs - targets) ** 2, -1)


def compute_absolute_pose_loss(
    outputs: Outputs, targets: Outputs, weights: tuple[float, ...]
) -> PerExample:
    """Compute the weighted mean absolute difference, the loss of a PoseNet over pins.

    A few outliers have less influence on it than on the squared one.
    """
    return jnp.mean(jnp.asarray([weights], outputs.dtype) * jnp.abs(outputs - targets), -1)


def compute_slide_loss(z_s: Float[Array, "B G"], target: Outputs) -> PerExample:
    """Compute the mean squared difference of the first numbers of z_s and the slide.

    The slide is scaled to [-1, 1] over its range. Where it is unknown, NaN, it does not count.
    """
    is_known = jnp.isfinite(target)
    error = jnp.where(is_known, z_s[:, : target.shape[1]] - jnp.where(is_known, target, 0), 0)
    return jnp.square(error).sum(1) / jnp.maximum(is_known.sum(1, dtype=error.dtype), 1)
