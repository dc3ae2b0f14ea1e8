"""Parts of a network by name: leaving them out, and what gradients reach."""

import jax
import jax.numpy as jnp

from tests.helpers.gradients import list_taught_parts


def drop_parts(variables, *parts):
    """Return variables without these parts of the network, as released ones are."""
    return {
        kind: {name: held for name, held in tree.items() if name not in parts}
        for kind, tree in variables.items()
    }


def find_taught_parts(compute, variables):
    """Return the parts that the gradient of `compute(variables)`, summed, reaches."""

    def total(params):
        return jnp.sum(compute(variables | {"params": params}))

    return list_taught_parts(jax.jit(jax.grad(total))(variables["params"]))
