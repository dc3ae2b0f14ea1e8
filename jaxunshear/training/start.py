"""Training that goes on from weights there are: `train.start`."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxunshear.errors import UserError
from jaxunshear.model.parts import Tree, leaves_of


class Start(NamedTuple):
    """Where a training begins, and what it is called in model.json."""

    variables: Tree
    digest: str


def started(fresh: Tree, start: Tree) -> Tree:
    """`fresh` variables with those of `start` in the places of its own; modules of `start` that it lacks are left out, and parts
    that `start` lacks (released weights hold no shear code and no DS) stay fresh.

    Raises UserError where a shape differs, a module of its own has fewer layers than that of `start`, or nothing of `start` has a place.
    """
    own, given = leaves_of(fresh), leaves_of(start)
    modules = {_module(name) for name in own}
    misplaced = next((name for name in given if name not in own and _module(name) in modules), None)
    if misplaced:
        raise UserError(f"start: {misplaced} is there and has no place here: use that network's settings")
    taken = {name: given[name] for name in own if name in given}
    if not taken:
        raise UserError("start: these weights have nothing in common with the network: name those of another")
    for name, leaf in taken.items():
        there, here = jnp.shape(leaf), jnp.shape(own[name])
        if there != here:
            raise UserError(f"start: {name} is {there} there and {here} here: use that network's settings")
    return jax.tree.unflatten(jax.tree.structure(fresh), (own | taken).values())


def _module(name: str) -> str:
    """Of a leaf: params.E of params.E.First_0.kernel."""
    return ".".join(name.split(".")[:2])
