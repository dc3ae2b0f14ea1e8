"""Training that goes on from weights there are: `train.start`."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import KeyPath
from jax.typing import ArrayLike

from jaxunshear.errors import UserError
from jaxunshear.model.parts import Tree


class Start(NamedTuple):
    """Where a training begins, and what it is called in model.json."""

    variables: Tree
    digest: str


def started(fresh: Tree, start: Tree) -> Tree:
    """`fresh` variables with those of `start` in the places of its own; modules of `start` that it lacks (a head) are left out, and parts
    that `start` lacks (released weights hold no shear code and no DS) stay fresh.

    Raises UserError where a shape differs, a module of its own has fewer layers than that of `start`, or nothing of `start` has a place.
    """
    given = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(start)}
    taken = []
    leaves = {path for path, _ in jax.tree_util.tree_leaves_with_path(fresh)}
    modules = {path[:2] for path in leaves}
    for path, _ in jax.tree_util.tree_leaves_with_path(start):
        if path[:2] in modules and path not in leaves:
            part = ".".join(str(key.key) for key in path)
            raise UserError(f"start: {part} is there and has no place here: use that network's settings")

    def chosen(path: KeyPath, own: ArrayLike) -> ArrayLike:
        name = jax.tree_util.keystr(path)
        if name not in given:
            return own
        if jnp.shape(given[name]) != jnp.shape(own):
            part, there, here = ".".join(str(key.key) for key in path), jnp.shape(given[name]), jnp.shape(own)
            raise UserError(f"start: {part} is {there} there and {here} here: use that network's settings")
        taken.append(name)
        return given[name]

    variables = jax.tree_util.tree_map_with_path(chosen, fresh)
    if not taken:
        raise UserError("start: these weights have nothing in common with the network: name those of another")
    return variables
