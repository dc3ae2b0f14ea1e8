"""Muon (Jordan et al. 2024) as an optax transformation.

Muon brings all singular values of the momentum near one. Adam scales every weight alone; Muon turns
the entire update of a kernel towards an orthogonal matrix, so that what has a weak gradient is
learnt as fast as what has a strong one.

The momentum is Jordan's. `optax.contrib.muon` corrects it for its start, which turns the second
update by 8 % and the thirtieth by less than half a per cent; all else is equal to rounding. Its
iteration multiplies the tall matrix of a convolution ten times per step, which takes longer than
the step itself. Here all but two products are between square matrices of the shorter side.
"""

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxunshear.models.weights import Variables

# of Jordan's quintic: steep at zero, and between 0.7 and 1.2 after all iterations
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
MOMENTUM = 0.95
# of an update at learning rate 1, near Adam's, so that both take the same rates
# (Liu et al. 2025, section 2.2)
RMS = 0.2
MAX_READOUT_WIDTH = 8  # kernels with fewer outputs


def muon(learning_rate: optax.ScalarOrSchedule, beta1: float) -> optax.GradientTransformation:
    """Make Muon for the inner kernels, and Adam for all other weights, as is usual.

    These are the kernels of the first and the last layer, biases and normalisation.
    """
    inner = optax.chain(
        optax.trace(MOMENTUM, nesterov=True),
        optax.stateless(lambda updates, _: jax.tree.map(_orthogonalise_kernel, updates)),
        optax.scale_by_learning_rate(learning_rate),
    )
    return optax.partition(
        {"muon": inner, "adam": optax.adam(learning_rate, beta1)}, _label_weights
    )


def orthogonalise(x: Array) -> Array:
    """Compute U f(S) V' of x = U S V' (m, n), with f near one for all but tiny singular values.

    This is a Newton-Schulz iteration. It maps x to x P with a polynomial P of x'x, so the
    iterations run on (n, n) alone and x is multiplied once.
    """
    if x.shape[0] < x.shape[1]:
        return orthogonalise(x.T).T
    x = x / (jnp.linalg.norm(x) + 1e-8)
    gram = _product(x.T, x)
    factors = jnp.eye(len(gram), dtype=x.dtype)
    a, b, c = COEFFICIENTS
    for iteration in range(ITERATIONS):
        factor = a * jnp.eye(len(gram), dtype=x.dtype) + b * gram + c * _product(gram, gram)
        factors = _product(factors, factor) if iteration else factor
        if iteration < ITERATIONS - 1:
            gram = _product(factor, _product(gram, factor))
    return _product(x, factors)


def _orthogonalise_kernel(kernel: Array) -> Array:
    """Orthogonalise the update of a convolution (k, k, C, N) or a dense layer (C, N).

    The rows of its matrix are all inputs of an output.
    """
    matrix = kernel.reshape(-1, kernel.shape[-1])
    return RMS * max(matrix.shape) ** 0.5 * orthogonalise(matrix).reshape(kernel.shape)


def _label_weights(params: Variables) -> Variables:
    def label(path: tuple, leaf: Array) -> str:
        if path[-1].key != "kernel":
            return "adam"
        is_inner = leaf.shape[-2] > 1 and leaf.shape[-1] >= MAX_READOUT_WIDTH
        return "muon" if is_inner else "adam"

    return jax.tree_util.tree_map_with_path(label, params)


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")
