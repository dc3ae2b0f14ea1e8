"""U-Net, a rival of UnshearNet, behind the same kind of pure functions.

>>> variables = init(net, jax.random.key(0))
>>> outputs, _ = reconstruct(net, variables, sheared)  # of images (B, S, S, 1) in [0, 1]
>>> canonical = jax.nn.sigmoid(outputs.canonical)

It is the network that image-to-image work would try first (Ronneberger et al. 2015). Every decoder
layer also takes the encoder's array of its own size, so there is no code that could hold a pose or
be swapped.
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxunshear.config import networks
from jaxunshear.config.types import raise_first_problem
from jaxunshear.models import layer_choice
from jaxunshear.models.fast import networks as fast
from jaxunshear.models.layers import Down, Last, Up
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.models.weights import Images, Variables


class Network(nn.Module):
    """Images (B, S, S, 1) -> logits (B, S, S, 1)."""

    net: networks.UNet

    @nn.compact
    def __call__(self, images: Array, train: bool) -> Array:
        first, *widths = self.net.widths
        arrays = [Down(first, name="First_0")(images, train)]
        for width in widths[:-1]:
            arrays.append(Down(width)(arrays[-1], train))
        x = Down(widths[-1])(arrays[-1], train)
        for width in reversed(self.net.widths[:-1]):
            x = jnp.concatenate([Up(width)(x, train), arrays.pop()], -1)
        return Last()(x, train)


def _make_network(net: networks.UNet) -> nn.Module:
    return layer_choice.pick_layer(Network, fast.UNet)(net)


def init(net: networks.UNet, key: Array) -> Variables:
    """Make fresh variables. Raises UserError if `size` and `widths` do not fit each other."""
    raise_first_problem(net, "U-Net")
    side = 2 ** len(net.widths)
    with layer_choice.use_layers(layer_choice.FAST):  # for the same weights with any layers
        return dict(_make_network(net).init(key, jnp.zeros((1, side, side, 1)), True))


def reconstruct(
    net: networks.UNet,
    variables: Variables,
    images: Images,
    key: Array | None = None,
    *_: Array | None,
) -> tuple[Reconstruction, Variables]:
    """Compute the logits of canonical images of sheared ones in [0, 1].

    In training, with any key, return the updated running statistics.
    """
    network = _make_network(net)
    if key is None:
        logits: Array = network.apply(variables, images, False)  # type: ignore[assignment]
        return Reconstruction(logits), variables["batch_stats"]
    canonical, updates = network.apply(variables, images, True, mutable=["batch_stats"])
    return Reconstruction(canonical), updates["batch_stats"]
