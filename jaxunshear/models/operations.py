"""Count the parameters and the floating-point operations of networks.

>>> measure_size(net, variables).operations  # of one image, or of the pins of one frame
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from jaxunshear.environment import PLAIN
from jaxunshear.models import registry
from jaxunshear.models.layer_choice import use_layers
from jaxunshear.models.pin_networks import render_pins
from jaxunshear.models.weights import Net, Variables


class NetworkSize(NamedTuple):
    """The size of a network."""

    parameters: int
    operations: float  # FLOPs of one frame


def measure_size(net: Net, variables: Variables, outputs: int = 0) -> NetworkSize:
    """Count the parameters of a network, and its operations as `count_operations` does."""
    parameters = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
    return NetworkSize(parameters, count_operations(net, variables, outputs))


def count_operations(net: Net, variables: Variables, outputs: int = 0) -> float:
    """Count the operations (FLOPs) with which a network processes one frame, by XLA's analysis.

    A network that unshears is counted from the input to the unsheared output; a multiplication and
    an addition are two operations. The count is of the plain layers before XLA optimises them, so
    all machines give the same. `outputs` is the number of a renderer's inputs.
    """
    functions = registry.get_functions(net)
    example = functions.modality.make_example(net, variables)
    run: Callable[..., object] = registry.unshear
    if functions.predict is not None:
        run = registry.predict
    elif functions.reconstruct is None:
        run, example = render_pins, np.zeros((1, outputs), np.float32)
    with use_layers(PLAIN):
        program = jax.jit(lambda *arguments: run(net, *arguments)).lower(variables, example)
    return float((program.cost_analysis() or {}).get("flops", 0.0))
