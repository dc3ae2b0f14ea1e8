"""Simulated pins as another sensor, camera and day would show them: networks that learn from these work on real skin.

draw = make_randomisation(rest, share)       # rest in px
batch = draw(batch, key)             # {"pins"}, or {"canonical_pins", "sheared_pins"} (B, P, 2) px, and {"edge"}

The dome is the same all round, so each batch is turned about its axis by one angle, and the edge's direction with it.
For each contact we draw how far its slide drags the pins, which depends on the friction of an unknown skin, and how the sensor
sits before its camera. Canonical pins keep their places, so that unshearing takes these away as well.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxunshear.angles import rotate_2d, wrap_degrees
from jaxunshear.files import Json
from jaxunshear.perception.lattice import measure_spacing
from jaxunshear.training.rotation import ANGLES, Rotations, make_rotations, rotate_pins

# Times the simulated motion of a slide, evenly in its logarithm. Skin that slips is dragged in proportion to its friction,
# we think: 0.2 to 0.8, as of rubber on plastic, is half to twice the fitted 0.39. No recorded slide decides this range.
MOTION_FACTOR = (0.5, 2.0)
TURNED_DEG, SHIFTED = (
    4.0,
    0.065,
)  # standard deviations of the camera's place; the latter in the pins' spacing

Batch = Json


def make_randomisation(
    rest: Float[np.ndarray, "P 2"],
    share: float,
    rotation_std_deg: float = TURNED_DEG,
    shift_std_spacings: float = SHIFTED,
) -> Callable[[Batch, Array], Batch]:
    """Draws `share` of all batches anew; the others are as the simulator gave them. The camera's place has standard deviations of
    `rotation_std_deg`, and of `shift_std_spacings` spacings of the pins."""
    turns, spacing_px = make_rotations(rest, 1), measure_spacing(rest)

    def draw(batch: Batch, key: Array) -> Batch:
        chance, angle, follow, camera = jax.random.split(key, 4)
        k = jax.random.randint(angle, (), 0, ANGLES)
        drawn = batch | _rotate_batch(turns, k, batch)
        if "sheared_pins" in drawn and "canonical_pins" in drawn:
            tap, slide = drawn["canonical_pins"], drawn["sheared_pins"]
            times = jax.random.uniform(follow, (len(tap), 1, 1), tap.dtype, *np.log(MOTION_FACTOR))
            drawn["sheared_pins"] = tap + jnp.exp(times) * (slide - tap)
        seen = "sheared_pins" if "sheared_pins" in drawn else "pins"
        drawn[seen] = _randomise_camera(
            turns.rest, drawn[seen], rotation_std_deg, shift_std_spacings * spacing_px, camera
        )
        some = jax.random.uniform(chance) < share
        return {name: jnp.where(some, drawn[name], value) for name, value in batch.items()}

    return draw


def _rotate_batch(turns: Rotations, k: Array, batch: Batch) -> Batch:
    """All pins of a batch turned by angle `k`, and the edge's direction, degrees in (-180, 180]."""
    after = {name: rotate_pins(turns, k, batch[name]) for name in batch if name.endswith("pins")}
    if "edge" in batch:
        degrees = batch["edge"][:, 1] + jnp.degrees(turns.radians[k])
        after["edge"] = jnp.stack([batch["edge"][:, 0], wrap_degrees(degrees)], -1)
    return after


def _randomise_camera(
    rest: Array, pins: Array, turned_deg: float, shift_px: float, key: Array
) -> Array:
    """Pins (B, P, 2) px of sensors that stand turned and shifted before their camera, each by its own."""
    angle, shift = jax.random.split(key)
    radians = jnp.radians(turned_deg) * jax.random.normal(angle, (len(pins), 1))
    middle = rest.mean(axis=0)
    moved = rotate_2d(pins - middle[None, None], radians)
    return middle[None, None] + moved + shift_px * jax.random.normal(shift, (len(pins), 1, 2))
