"""Layers of networks over pins, and the module of the one that unshears."""

import math
from collections.abc import Callable

import flax.linen as nn
import jax.numpy as jnp
from jax import Array, lax

from jaxunshear.config.networks import PinNet, PinUnshear
from jaxunshear.models import layer_choice
from jaxunshear.models.fast import conv

PLAIN_CONVOLUTION: Callable[..., Array] = lax.conv_general_dilated
FAST_CONVOLUTION: Callable[..., Array] = conv.convolve


class GridTrunk(nn.Module):
    """Convolutions over the grid, each normalised over its channels, then a dense layer.

    The second and later convolutions halve the side. `tasks` are shares (B, T), if there are any.
    """

    net: PinNet

    @nn.compact
    def __call__(self, motions: Array, grid: Array, *tasks: Array) -> Array:
        count, side, he = len(motions), math.isqrt(grid.shape[1]), nn.initializers.he_normal()
        grid_motions = jnp.einsum("bpi,pg->bgi", motions.reshape(count, -1, 2), grid)
        is_inside = jnp.any(grid != 0, axis=0).astype(grid_motions.dtype)
        is_inside = jnp.broadcast_to(is_inside[None, :, None], (count, len(is_inside), 1))
        masks = [is_inside * shares[:, None] for shares in tasks]
        x = jnp.concatenate([grid_motions, is_inside, *masks], -1).reshape(count, side, side, -1)
        convolution = layer_choice.pick_layer(PLAIN_CONVOLUTION, FAST_CONVOLUTION)
        for number, channels in enumerate(self.net.conv_channels):
            stride = 2 if number else 1
            layer = nn.Conv(
                channels, (3, 3), stride, kernel_init=he, conv_general_dilated=convolution
            )
            x = nn.gelu(nn.LayerNorm()(layer(x)))
        dense = nn.Dense(self.net.hidden, kernel_init=he)
        return nn.gelu(nn.LayerNorm()(dense(x.reshape(count, -1))))


class Trunk(nn.Module):
    """Dense layers, each normalised over its units. `tasks` are shares (B, T), if there are any."""

    net: PinNet

    @nn.compact
    def __call__(self, x: Array, *tasks: Array) -> Array:
        x = jnp.concatenate([x, *tasks], -1)
        for _ in range(self.net.layers):
            dense = nn.Dense(self.net.hidden, kernel_init=nn.initializers.he_normal())
            x = nn.gelu(nn.LayerNorm()(dense(x)))
        return x


class Dense(nn.Module):
    """A trunk with a linear output, which starts near zero. With a grid (P, G), it convolves."""

    net: PinNet
    outputs: int

    @nn.compact
    def __call__(self, x: Array, *grid: Array) -> Array:
        small = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
        trunk = GridTrunk(self.net) if grid else Trunk(self.net)
        return nn.Dense(self.outputs, kernel_init=small)(trunk(x, *grid))


class PinUnshearModule(nn.Module):
    """E, DC and DS under their names in the paper, over motions (B, 2 P).

    With a grid (P, G) after the motions, E convolves. The shares of tasks (B, T) come last, if
    there are any.
    """

    net: PinUnshear
    motions: int

    def setup(self) -> None:
        net = self.net
        self.E = GridTrunk(net) if net.conv_channels else Trunk(net)
        self.pose, self.DC = nn.Dense(net.pose_code), Dense(net, self.motions)
        if net.shear_code:
            self.shear, self.DS = nn.Dense(net.shear_code), Dense(net, self.motions)
            self.ES = Trunk(net) if net.separate_encoders else None

    def pose_code(self, motions: Array, *others: Array) -> Array:
        return self.pose(self.E(motions, *others))

    def encode(self, motions: Array, *others: Array) -> tuple[Array, Array | None]:
        z = self.E(motions, *others)
        if not self.net.shear_code:
            return self.pose(z), None
        return self.pose(z), self.shear(z if self.ES is None else self.ES(motions))

    def decode_canonical(self, z_p: Array) -> Array:
        return self.DC(z_p)

    def decode_sheared(self, z_p: Array, z_s: Array) -> Array:
        return self.DS(jnp.concatenate([z_p, z_s], -1))

    def __call__(self, motions: Array, *others: Array) -> tuple[Array, Array | None]:
        z_p, z_s = self.encode(motions, *others)
        return self.DC(z_p), None if z_s is None else self.decode_sheared(z_p, z_s)
