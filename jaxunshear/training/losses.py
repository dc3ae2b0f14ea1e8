"""The size of kernels: their regularisation, and what is logged of it."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxunshear.models.weights import Variables, list_leaves


def compute_regularisation(
    params: Variables, l1: float, l2: float, kernels: str = "sum"
) -> Float[Array, ""]:
    """Compute l1 sum |w| + l2 sum w^2 of each kernel, and add these up.

    With `kernels` "mean" the sums over a kernel are means. Biases and normalisation are left out. A
    weight of zero computes nothing.
    """
    reduce = {"sum": jnp.sum, "mean": jnp.mean}[kernels]
    total = jnp.zeros(())
    for kernel in list_kernels(params).values():
        total += l1 * reduce(jnp.abs(kernel)) if l1 else 0.0
        total += l2 * reduce(kernel**2) if l2 else 0.0
    return total


def measure_kernel_sizes(params: Variables) -> dict[str, Float[Array, ""]]:
    """Measure the root mean square of each kernel, by dotted name: 0.02 in fresh networks."""
    return {name: jnp.sqrt(jnp.mean(kernel**2)) for name, kernel in list_kernels(params).items()}


def list_kernels(params: Variables) -> dict[str, Array]:
    """List the kernels of convolution and dense layers, by dotted name."""
    return {
        name.removesuffix(".kernel"): leaf
        for name, leaf in list_leaves(params).items()
        if name.endswith(".kernel")
    }
