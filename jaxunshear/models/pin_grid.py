"""Motions of pins laid on a square grid, for convolutions: neighbouring pins move alike, which dense layers have to learn.

>>> grid = make_grid(rest)                      # (P, G): what each pin counts at each place; 0 outside the pins
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

GRID_NEIGHBOURS = 30  # pins that the motion at a place is interpolated from
CONVOLUTIONS: tuple[Callable[..., Array], ...] = (
    lax.conv_general_dilated,
    patches.convolution,
)  # plain and fast
MAX_GRID_DISTANCE = 1.2  # pin spacings from the nearest pin: a place is still among them


def make_grid(rest: Float[ArrayLike, "P 2"]) -> Float[np.ndarray, "P G"]:
    """Of pins that stand untouched at `rest` px: G places in rows, as far apart as pins, each interpolated by linear splines."""
    pins = np.asarray(rest, np.float64)
    low, high = pins.min(axis=0), pins.max(axis=0)
    spacing = measure_spacing(pins)
    side = max(2, round(float(np.max(high - low)) / spacing))
    columns, rows = np.meshgrid(*np.linspace(low, high, side).T)
    places = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    spline = RBFInterpolator(
        pins, np.eye(len(pins)), neighbors=min(GRID_NEIGHBOURS, len(pins)), kernel="linear"
    )
    inside = cKDTree(pins).query(places)[0] < MAX_GRID_DISTANCE * spacing
    return np.where(inside[:, None], spline(places), 0).T.astype(np.float32)


class GridTrunk(nn.Module):
    """Convolutions over the grid, the second and later ones to half the side, each normalised over its channels; then a dense layer."""

    net: PinNet

    @nn.compact
    def __call__(self, motions: Array, grid: Array) -> Array:
        count, side, he = len(motions), math.isqrt(grid.shape[1]), nn.initializers.he_normal()
        laid = jnp.einsum("bpi,pg->bgi", motions.reshape(count, -1, 2), grid)
        inside = jnp.any(grid != 0, axis=0).astype(laid.dtype)
        inside = jnp.broadcast_to(inside[None, :, None], (count, len(inside), 1))
        x = jnp.concatenate([laid, inside], -1).reshape(count, side, side, 3)
        way = layer_choice.pick_layer(*CONVOLUTIONS)
        for number, channels in enumerate(self.net.convolved):
            stride = 2 if number else 1
            convolve = nn.Conv(channels, (3, 3), stride, kernel_init=he, conv_general_dilated=way)
            x = nn.gelu(nn.LayerNorm()(convolve(x)))
        return nn.gelu(
            nn.LayerNorm()(nn.Dense(self.net.hidden, kernel_init=he)(x.reshape(count, -1)))
        )
