"""Weights by their parts: released ones leave out the shear code and DS."""

import warnings
from functools import partial
from typing import Any

import jax
from jax import Array
from jaxtyping import Float

from jaxunshear.errors import Note, UserError

# {"params": ..., "batch_stats": ...}, each by module, as E, pose, shear, DC, DS; or one of these
Variables = dict[str, Any]
Net = Any  # settings of a network, of whichever kind
AnyArray = Any  # of JAX or NumPy, as the argument
Tree = Any  # weights, a state or a part of them

Images = Float[Array, "B S S 1"]
Pins = Float[Array, "B P 2"]  # px
Outputs = Float[Array, "B K"]  # of all pose targets, see `posenet`
PerExample = Float[Array, "B"]


def list_leaves(tree: Tree) -> dict[str, Any]:
    """List the leaves by dotted path ("params.E.First_0.kernel"), in the tree's order."""
    name = partial(jax.tree_util.keystr, simple=True, separator=".")
    return {name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def get_module(name: str) -> str:
    """Return the module that a leaf's dotted path is of: "params.E" of the one above."""
    return ".".join(name.split(".")[:2])


def has_part(variables: Variables, part: str) -> bool:
    """Return whether these weights hold `part` of a network; note a missing shear code."""
    has = part in variables["params"]
    if not has and part == "shear":
        message = (
            "these weights hold no shear code, as released ones do: z_p alone is given; "
            "a run's own hold both"
        )
        warnings.warn(message, Note, stacklevel=3)
    return has


def check_has_sheared_decoder(variables: Variables) -> None:
    """Raise UserError for weights without DS."""
    if not has_part(variables, "DS"):
        raise UserError(
            "these weights hold no DS to draw sheared contacts, as released ones do: "
            "load those of the run itself"
        )
