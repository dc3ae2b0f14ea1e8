"""The cells of appendix D, and more of their kind: which codes each decoder is fed, and what it then draws."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.evaluation.score import CELLS
from jaxunshear.model import unshearnet
from jaxunshear.model.parts import Variables
from jaxunshear.settings.networks import UnshearNet

# Codes of DC, or of DS' pose and shear slots: z_p, z_s; 0: blank, ~: its numbers shuffled, *: that of the image half a batch on.
SPOILT: dict[str, tuple[str, ...]] = {
    "DC(z_p)": ("p",),
    "DC(z_s)": ("s",),
    "DC(0)": ("0p",),
    "DC(shuffled z_p)": ("~p",),
    "DC(z_p of another)": ("*p",),
    "DS(z_p,z_s)": ("p", "s"),
    "DS(z_p,z_p)": ("p", "p"),
    "DS(z_s,z_s)": ("s", "s"),
    "DS(z_p,0)": ("p", "0s"),
    "DS(0,z_s)": ("0p", "s"),
    "DS(z_p,shuffled z_s)": ("p", "~s"),
    "DS(shuffled z_p,z_s)": ("~p", "s"),
    "DS(z_p,z_s of another)": ("p", "*s"),
    "DS(z_p of another,z_s)": ("*p", "s"),
}


def draw_cells(
    net: UnshearNet, variables: Variables, sheared: Array, names: Iterable[str] = CELLS, key: Array | None = None
) -> dict[str, Array]:
    """Images (B, S, S, 1) in [0, 1] of the named cells that the network has, from the codes of `sheared` (B, S, S, 1).

    Without a shear code there is only DC's pose code; a code in the other's place needs codes of one width. `key` for shuffling.
    """
    z_p, z_s = unshearnet.encode(net, variables, sheared)

    def code(name: str) -> Array | None:
        z = z_p if name[-1] == "p" else z_s
        if z is None or name[0] in "ps":
            return z
        if name[0] == "0":
            return jnp.zeros_like(z)
        if name[0] == "*":
            return jnp.roll(z, len(z) // 2, axis=0)
        keys = jax.random.split(jax.random.key(0) if key is None else key, len(z))
        return jax.vmap(lambda one, own: jax.random.permutation(own, one.ravel()).reshape(one.shape))(z, keys)

    drawn = {}
    for cell in names:
        first, *second = (code(name) for name in SPOILT[cell])
        if first is None or first.shape != z_p.shape:
            continue
        if not second:
            drawn[cell] = unshearnet.decode_canonical(net, variables, first)
        elif z_s is not None and second[0] is not None and second[0].shape == z_s.shape:
            drawn[cell] = unshearnet.decode_sheared(net, variables, first, second[0])
    return {name: jax.nn.sigmoid(logits) for name, logits in drawn.items()}
