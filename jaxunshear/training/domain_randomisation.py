"""Domain randomisation: simulated pins as another sensor, camera and day would show them.

Networks that learn from such pins work on real skin.

randomise = make_randomisation(rest, share)  # rest in px
# {"pins"}, or {"canonical_pins", "sheared_pins"} (B, P, 2) px, and {"edge"}
batch = randomise(batch, key)

The dome is the same all round, so each batch is turned about its axis by one angle, and the edge's
direction with it. For each contact we draw how far its slide drags the pins, which depends on the
friction of an unknown skin, and how the sensor sits before its camera. Canonical pins keep their
places, so unshearing removes the camera's place as well.
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

# Factor of the simulated motion of a slide, uniform in its logarithm. We assume that skin which
# slips is dragged in proportion to its friction: 0.2 to 0.8, as of rubber on plastic, is half to
# twice the fitted 0.39. No recorded slide decides this range.
MOTION_FACTOR = (0.5, 2.0)
# standard deviations of the camera's place
TURNED_DEG = 4.0
SHIFTED = 0.065  # in spacings of the pins

Batch = Json


def make_randomisation(
    rest: Float[np.ndarray, "P 2"], share: float
) -> Callable[[Batch, Array], Batch]:
    """Make the function that randomises a `share` of all batches; the others stay as they are."""
    rotations, spacing_px = make_rotations(rest, 1), measure_spacing(rest)

    def randomise(batch: Batch, key: Array) -> Batch:
        chance_key, angle_key, motion_key, camera_key = jax.random.split(key, 4)
        k = jax.random.randint(angle_key, (), 0, ANGLES)
        randomised = batch | _rotate_batch(rotations, k, batch)
        if "sheared_pins" in randomised and "canonical_pins" in randomised:
            tap, slide = randomised["canonical_pins"], randomised["sheared_pins"]
            log_factor = jax.random.uniform(
                motion_key, (len(tap), 1, 1), tap.dtype, *np.log(MOTION_FACTOR)
            )
            randomised["sheared_pins"] = tap + jnp.exp(log_factor) * (slide - tap)
        field = "sheared_pins" if "sheared_pins" in randomised else "pins"
        randomised[field] = _randomise_camera(
            rotations.rest, randomised[field], SHIFTED * spacing_px, camera_key
        )
        is_randomised = jax.random.uniform(chance_key) < share
        return {
            name: jnp.where(is_randomised, randomised[name], value) for name, value in batch.items()
        }

    return randomise


def _rotate_batch(rotations: Rotations, k: Array, batch: Batch) -> Batch:
    """Turn all pins of a batch by angle `k`, and the edge's direction, degrees in (-180, 180]."""
    rotated = {
        name: rotate_pins(rotations, k, batch[name]) for name in batch if name.endswith("pins")
    }
    if "edge" in batch:
        degrees = batch["edge"][:, 1] + jnp.degrees(rotations.radians[k])
        rotated["edge"] = jnp.stack([batch["edge"][:, 0], wrap_degrees(degrees)], -1)
    return rotated


def _randomise_camera(rest: Array, pins: Array, shift_px: float, key: Array) -> Array:
    """Turn and shift the sensor of each example before its camera, pins (B, P, 2) px."""
    angle_key, shift_key = jax.random.split(key)
    radians = jnp.radians(TURNED_DEG) * jax.random.normal(angle_key, (len(pins), 1))
    middle = rest.mean(axis=0)
    rotated = rotate_2d(pins - middle[None, None], radians)
    shape = (len(pins), 1, 2)
    return middle[None, None] + rotated + shift_px * jax.random.normal(shift_key, shape)
