"""Compile trained networks for use, image after image.

>>> run = jit_for_inference(partial(unshearnet.unshear, net), variables)
>>> run(images)

The weights are constants of the compiled program. What depends on them alone (kernels rearranged
for `fast/conv.py`, the norm's factors) is computed once, by the compiler; it would cost a single
image up to a third of its time.
"""

from collections.abc import Callable
from typing import TypeVar

import jax

from jaxunshear.models.weights import Variables

Outputs = TypeVar("Outputs")


def jit_for_inference(run: Callable[..., Outputs], variables: Variables) -> Callable[..., Outputs]:
    """Jit `run(variables, ...)` as a function of its other arguments.

    Products have the precision of the inputs, also on a GPU, which would round float32 to ten bits:
    outputs are the same there as on a CPU.
    """
    constants = jax.device_get(variables)

    def run_with_constants(*inputs: object) -> Outputs:
        with jax.default_matmul_precision("highest"):
            return run(constants, *inputs)

    return jax.jit(run_with_constants)
