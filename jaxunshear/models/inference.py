"""Trained networks made ready for use, image after image.

>>> run = jit_for_inference(lambda variables, images: unshearnet.unshear(net, variables, images), variables)
>>> run(images)

The weights are constants of the compiled program: what depends on them alone (kernels rearranged for `fast/conv.py`, the norm's
factors) is computed once, by the compiler, where it would cost a single image up to a third of its time.
"""

from collections.abc import Callable
from typing import TypeVar

import jax

from jaxunshear.models.weights import Variables

Answer = TypeVar("Answer")


def jit_for_inference(run: Callable[..., Answer], variables: Variables) -> Callable[..., Answer]:
    """`run(variables, ...)` as a jitted function of the rest. Its products are in the precision of what it is given, also on a GPU, which
    would round float32 to ten bits: a network answers there as on a CPU."""
    constants = jax.device_get(variables)

    def answer(*inputs: object) -> Answer:
        with jax.default_matmul_precision("highest"):
            return run(constants, *inputs)

    return jax.jit(answer)
