"""Training that goes on from weights there are: `train.start`."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxunshear.errors import UserError

Tree = Any


class Start(NamedTuple):
    """Where a training begins, and what it is called in model.json."""

    variables: Tree
    digest: str


def begun(fresh: Tree, start: Tree) -> Tree:
    """`fresh` variables with those of `start` in the places of its own; parts of `start` that it lacks (a head) are left out, and parts
    that `start` lacks (released weights hold no shear code and no DS) stay fresh.

    Raises UserError where a shape differs, or nothing of `start` has a place.
    """
    named = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(start)}
    paths = jax.tree_util.tree_leaves_with_path(fresh)
    taken = [(path, named[name]) for path, _ in paths if (name := jax.tree_util.keystr(path)) in named]
    if not taken:
        raise UserError("start: these weights have nothing in common with the network: name those of another")
    own = {jax.tree_util.keystr(path): leaf for path, leaf in paths}
    for path, leaf in taken:
        name = jax.tree_util.keystr(path)
        if jnp.shape(leaf) != jnp.shape(own[name]):
            parts = ".".join(str(key.key) for key in path)
            raise UserError(
                f"start: {parts} is {jnp.shape(leaf)} there and {jnp.shape(own[name])} here: use that network's settings"
            )
    return jax.tree_util.tree_map_with_path(lambda path, leaf: named.get(jax.tree_util.keystr(path), leaf), fresh)
