"""Decode swapped codes: the cells of the paper's appendix D, and some more."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.config.networks import UnshearNet
from jaxunshear.evaluation.score import CELLS
from jaxunshear.models import unshearnet
from jaxunshear.models.weights import Variables

# Codes of DC, or of DS' pose and shear slots: z_p, z_s; 0: blank; *: of another image
SWAP_CELLS: dict[str, tuple[str, ...]] = {
    "DC(z_p)": ("p",),
    "DC(z_s)": ("s",),
    "DS(z_p,z_s)": ("p", "s"),
    "DS(z_p,z_p)": ("p", "p"),
    "DS(z_p,0)": ("p", "0s"),
    "DS(0,z_s)": ("0p", "s"),
    "DS(z_p,z_s of another)": ("p", "*s"),
}


def decode_cells(
    net: UnshearNet,
    variables: Variables,
    sheared: Array,
    names: Iterable[str] = CELLS,
    other: Array | None = None,
) -> dict[str, Array]:
    """Decode images (B, S, S, 1) in [0, 1] of the named cells from the codes of `sheared`.

    Codes of another image are those of `other` (B, S, S, 1). Cells that the network cannot decode
    are left out: without a shear code there is only DC's pose code, and a code in the other's place
    needs codes of one width.
    """
    own = unshearnet.encode(net, variables, sheared)
    foreign = own if other is None else unshearnet.encode(net, variables, other)
    z_p, z_s = own

    def get_code(name: str) -> Array | None:
        z = (foreign if name[0] == "*" else own)["ps".index(name[-1])]
        return jnp.zeros_like(z) if z is not None and name[0] == "0" else z

    logits = {}
    for cell in names:
        codes = [get_code(name) for name in SWAP_CELLS[cell]]
        if codes[0] is None or codes[0].shape != z_p.shape:
            continue
        if len(codes) == 1:
            logits[cell] = unshearnet.decode_canonical(net, variables, codes[0])
        elif z_s is not None and codes[1] is not None and codes[1].shape == z_s.shape:
            logits[cell] = unshearnet.decode_sheared(net, variables, codes[0], codes[1])
    return {name: jax.nn.sigmoid(values) for name, values in logits.items()}
