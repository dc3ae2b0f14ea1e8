"""The paper's losses (section 3.3) as named terms per example; `step.py` weighs and adds them.

One sum gives every module the gradient the paper lists for it: E sees all terms, DC `supervised` and `patch`, DS
`reconstruction`, since no other path leads from a term to a module.
"""

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.model.parts import Variables


def supervised(canonical: Array, target: Array) -> Array:
    """L_sup: mean squared difference of images (B, S, S, 1) in [0, 1] -> (B,)."""
    return jnp.mean((canonical - target) ** 2, (1, 2, 3))


def reconstruction(sheared: Array, target: Array) -> Array:
    """L_rec: the same, of the sheared image."""
    return supervised(sheared, target)


def patch(canonical: Array, target: Array, counts: Array) -> Array:
    """L_patch: mean absolute difference over all pixels of all crops -> (B,). `counts` (B, S, S): crops that cover a
    pixel."""
    difference = jnp.abs(canonical - target)[..., 0]
    return jnp.sum(counts * difference, (1, 2)) / jnp.sum(counts, (1, 2))


def coverage(corners: Array, size: int, side: int) -> Array:
    """How many crops of `side` pixels cover each pixel: corners (B, crops, 2) [row, column] -> counts (B, size, size).

    A crop is the outer product of an indicator of its rows and one of its columns, so the counts are one matrix
    product and the crops themselves are never cut out.
    """
    start = corners[..., None]
    pixel = jnp.arange(size)[None, None, None]
    rows, columns = jnp.moveaxis(((pixel >= start) & (pixel < start + side)).astype(jnp.float32), 2, 0)
    return jnp.einsum("bkr,bkc->brc", rows, columns, precision="highest")


def random_corners(key: Array, images: int, crops: int, size: int, side: int) -> Array:
    """Uniform upper left corners (images, crops, 2) of crops that lie in the image."""
    return jax.random.randint(key, (images, crops, 2), 0, size - side + 1)


def pose(outputs: Array, targets: Array, weights: tuple[float, ...]) -> Array:
    """PoseNet's L2 loss: weighted mean squared difference of outputs (B, 5) and targets -> (B,)."""
    return jnp.mean(jnp.asarray(weights, outputs.dtype) * (outputs - targets) ** 2, -1)


def absolute_pose(outputs: Array, targets: Array, weights: tuple[float, ...]) -> Array:
    """The same with absolute differences, which a few contacts that are hard to read bend less: of networks over pins."""
    return jnp.mean(jnp.asarray(weights, outputs.dtype) * jnp.abs(outputs - targets), -1)


def regularisation(params: Variables, l1: float, l2: float, kernels: str = "sum") -> Array:
    """l1 sum |w| + l2 sum w^2 over each kernel (no biases, no normalisation), or their "mean"; added up over all of
    them. A weight of zero computes nothing."""
    over = {"sum": jnp.sum, "mean": jnp.mean}[kernels]
    total = jnp.zeros(())
    for kernel in kernels_of(params).values():
        total += l1 * over(jnp.abs(kernel)) if l1 else 0.0
        total += l2 * over(kernel**2) if l2 else 0.0
    return total


def kernel_sizes(params: Variables) -> dict[str, Array]:
    """The root of the mean square of each kernel's weights, by its dotted name: 0.02 in fresh networks."""
    return {name: jnp.sqrt(jnp.mean(kernel**2)) for name, kernel in kernels_of(params).items()}


def kernels_of(params: Variables) -> dict[str, Array]:
    """The kernels of convolution and dense layers, by dotted name."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {
        jax.tree_util.keystr(path[:-1], simple=True, separator="."): leaf
        for path, leaf in leaves
        if path[-1].key == "kernel"
    }
