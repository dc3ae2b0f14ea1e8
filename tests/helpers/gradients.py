"""What gradients reach."""

import jax
import numpy as np


def list_taught_parts(slopes):
    """Return the names of the parts of a network whose gradient is not exactly zero."""
    return {
        part
        for part, slope in slopes.items()
        if any(np.any(leaf) for leaf in jax.tree.leaves(slope))
    }
