"""Motions of pins interpolated on a square grid, for convolutions.

Neighbouring pins move alike, which dense layers have to learn.

>>> grid = make_grid(rest)  # (P, G): the weight of each pin at each grid point; 0 outside the pins
>>> GridTrunk(net).apply(variables, motions, grid)
"""

import math
from collections.abc import Callable

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from jaxunshear.config.networks import PinNet
from jaxunshear.models import layer_choice
from jaxunshear.models.fast import patches
from jaxunshear.perception.lattice import measure_spacing

GRID_NEIGHBOURS = 30  # pins that the motion at a grid point is interpolated from
MAX_GRID_DISTANCE = 1.2  # pin spacings from the nearest pin to a grid point that has a motion
PLAIN_CONVOLUTION: Callable[..., Array] = lax.conv_general_dilated
FAST_CONVOLUTION: Callable[..., Array] = patches.convolve


def make_grid(rest: Float[ArrayLike, "P 2"]) -> Float[np.ndarray, "P G"]:
    """Make the grid of pins that rest at `rest` px: G points in rows, in the spacing of the pins.

    Motions at these points are interpolated by linear splines.
    """
    pins = np.asarray(rest, np.float64)
    low, high = pins.min(axis=0), pins.max(axis=0)
    spacing = measure_spacing(pins)
    side = max(2, round(float(np.max(high - low)) / spacing))
    columns, rows = np.meshgrid(*np.linspace(low, high, side).T)
    points = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    spline = RBFInterpolator(
        pins, np.eye(len(pins)), neighbors=min(GRID_NEIGHBOURS, len(pins)), kernel="linear"
    )
    is_inside = cKDTree(pins).query(points)[0] < MAX_GRID_DISTANCE * spacing
    return np.where(is_inside[:, None], spline(points), 0).T.astype(np.float32)


class GridTrunk(nn.Module):
    """Convolutions over the grid, each normalised over its channels, then a dense layer.

    The second and later convolutions halve the side.
    """

    net: PinNet

    @nn.compact
    def __call__(self, motions: Array, grid: Array) -> Array:
        count, side, he = len(motions), math.isqrt(grid.shape[1]), nn.initializers.he_normal()
        grid_motions = jnp.einsum("bpi,pg->bgi", motions.reshape(count, -1, 2), grid)
        is_inside = jnp.any(grid != 0, axis=0).astype(grid_motions.dtype)
        is_inside = jnp.broadcast_to(is_inside[None, :, None], (count, len(is_inside), 1))
        x = jnp.concatenate([grid_motions, is_inside], -1).reshape(count, side, side, 3)
        convolution = layer_choice.pick_layer(PLAIN_CONVOLUTION, FAST_CONVOLUTION)
        for number, channels in enumerate(self.net.convolved):
            stride = 2 if number else 1
            layer = nn.Conv(
                channels, (3, 3), stride, kernel_init=he, conv_general_dilated=convolution
            )
            x = nn.gelu(nn.LayerNorm()(layer(x)))
        dense = nn.Dense(self.net.hidden, kernel_init=he)
        return nn.gelu(nn.LayerNorm()(dense(x.reshape(count, -1))))
