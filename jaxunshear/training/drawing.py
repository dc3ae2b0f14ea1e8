"""Simulated pins as another sensor, camera and day would show them: networks that learn from these work on real skin.

draw = drawing_of(rest, share)       # rest in px
batch = draw(batch, key)             # {"pins"}, or {"canonical_pins", "sheared_pins"} (B, P, 2) px, and {"edge"}

The dome is the same all round, so each batch is turned about its axis by one angle, and the edge's direction with it.
For each contact we draw how far its slide drags the pins, which depends on the friction of an unknown skin. Some do not slide.
We also draw how the sensor sits before its camera, and how far off a slide's untouched places are. Canonical pins keep their
places, so that unshearing takes these away as well. No range here was measured on recorded slides.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxunshear.image.lattice import spacing_of
from jaxunshear.storage import Json
from jaxunshear.training.turning import ANGLES, Turns, turned, turns_of

# Times the simulated motion of a slide, evenly in its logarithm. Skin that slips is dragged about in proportion to friction:
# from 0.2 to 0.8, as of rubber on plastic, is half to twice the fitted 0.39.
FOLLOW = (0.5, 2.0)
STILL = 0.2  # share of the contacts that do not slide at all: a tap is to come out as it went in
TURNED_DEG, SHIFTED = 4.0, 0.065  # standard deviations of the camera's place; the latter in the pins' spacing
# Standard deviation of the untouched places, in the pins' spacing: they are means over the contacts of a folder, of whose
# depths and edges nothing is known. The mean over 20 contacts alone errs by half of this.
MISPLACED = 0.11
ORDER = 3  # of the polynomials that misplaced pins follow

Batch = Json


class Spread(NamedTuple):
    """Standard deviations of how a sensor sits before its camera."""

    turned_deg: float = TURNED_DEG
    shifted: float = SHIFTED  # in the pins' spacing
    misplaced: float = MISPLACED  # of all pins' untouched places, in their spacing


def drawing_of(
    rest: Float[np.ndarray, "P 2"], share: float, spread: Spread = Spread(), still: float = STILL
) -> Callable[[Batch, Array], Batch]:
    """Draws `share` of all batches anew; the others are as the simulator gave them. `still` is the share of contacts that
    do not slide."""
    turns, spacing_px = turns_of(rest, 1), spacing_of(rest)
    fields = jnp.asarray(smooth_fields(rest), jnp.float32)
    before_camera = partial(_before_camera, turns.rest, spread, spacing_px)
    misplaced = partial(_misplaced, fields, spread.misplaced * spacing_px)

    def draw(batch: Batch, key: Array) -> Batch:
        chance, angle, follow, camera = jax.random.split(key, 4)
        place = jax.random.fold_in(key, 4)
        k = jax.random.randint(angle, (), 0, ANGLES)
        drawn = batch | _turned(turns, k, batch)
        if "sheared_pins" in drawn and "canonical_pins" in drawn:
            tap, slide = drawn["canonical_pins"], drawn["sheared_pins"]
            times = _times(follow, len(tap), still)[:, None, None]
            drawn["sheared_pins"] = tap + times * (slide - tap) + misplaced(len(tap), place)
        seen = "sheared_pins" if "sheared_pins" in drawn else "pins"
        drawn[seen] = before_camera(drawn[seen], camera)
        some = jax.random.uniform(chance) < share
        return {name: jnp.where(some, drawn[name], value) for name, value in batch.items()}

    return draw


def smooth_fields(rest: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "F P 2"]:
    """All polynomial displacements of pins up to ORDER, along x and along y; of each the mean length is 1 (root mean square)."""
    offset = rest - rest.mean(axis=0)
    x, y = (offset / np.abs(offset).max()).T
    shapes = np.stack([x**i * y ** (n - i) for n in range(ORDER + 1) for i in range(n + 1)])
    shapes[1:] -= shapes[1:].mean(axis=1, keepdims=True)  # the first alone shifts all pins
    shapes /= np.sqrt(np.mean(shapes**2, axis=1, keepdims=True))
    return (shapes[:, None, :, None] * np.eye(2)[None, :, None, :]).reshape(-1, len(rest), 2)


def _times(key: Array, count: int, still: float) -> Array:
    """How many times as far as simulated each of `count` slides drags the pins, (B,)."""
    low, high = np.log(FOLLOW)
    farther, chance = jax.random.split(key)
    times = jnp.exp(jax.random.uniform(farther, (count,), minval=low, maxval=high))
    return jnp.where(jax.random.uniform(chance, (count,)) < still, 0, times)


def _misplaced(fields: Array, size_px: float, count: int, key: Array) -> Array:
    """How far pins appear to have moved (B, P, 2) px, as their untouched places are known wrongly: smooth, of `size_px`."""
    sizes = size_px / np.sqrt(len(fields)) * jax.random.normal(key, (count, len(fields)))
    return jnp.einsum("bf,fpi->bpi", sizes, fields)


def _turned(turns: Turns, k: Array, batch: Batch) -> Batch:
    """All pins of a batch turned by angle `k`, and the edge's direction, degrees in (-180, 180]."""
    after = {name: turned(turns, k, batch[name]) for name in batch if name.endswith("pins")}
    if "edge" in batch:
        degrees = batch["edge"][:, 1] + jnp.degrees(turns.radians[k])
        after["edge"] = jnp.stack([batch["edge"][:, 0], 180 - (180 - degrees) % 360], -1)
    return after


def _before_camera(rest: Array, spread: Spread, spacing_px: float, pins: Array, key: Array) -> Array:
    """Pins (B, P, 2) px of sensors that sit turned and shifted before their camera, each by its own."""
    angle, shift = jax.random.split(key)
    radians = jnp.radians(spread.turned_deg) * jax.random.normal(angle, (len(pins), 1))
    cosine, sine = jnp.cos(radians), jnp.sin(radians)
    middle = rest.mean(axis=0)
    x, y = jnp.moveaxis(pins - middle[None, None], -1, 0)
    moved = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], -1)
    shifts = spread.shifted * spacing_px * jax.random.normal(shift, (len(pins), 1, 2))
    return middle[None, None] + moved + shifts
