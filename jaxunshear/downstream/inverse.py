"""How far the skin is pressed in, from how far the pins have moved: one matrix, so that pins at rest give no indentation.

>>> inverse = learnt(lattice, motion, indentation)     # (2P, P) mm/px, of taps whose indentation is known, or `of_compliance`
>>> indentation_of(inverse, motion)                    # (N, P) mm

The cells of the pins hold only how the skin is stretched; their motion also holds where to, and how it turns. Skin and gel are
linear to about 3 mm, so a linear map does.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.contact.indentation import per_force
from jaxunshear.contact.systems import dome
from jaxunshear.image.camera import project, to_image_px
from jaxunshear.image.lattice import Lattice
from jaxunshear.settings.image import Camera, Preprocess
from jaxunshear.settings.sensor import Sensor

NOISE = 0.06  # spacings by which a pin's coordinates may be off: 0.3 px at 128 px
SIGNAL = 10.0  # times as far as the noise, touches move pins (rms)
FELT_MM = 0.2  # images of the untouched sensor of 128 px give up to 0.1


def learnt(lattice: Lattice, motion: np.ndarray, indentation: np.ndarray) -> np.ndarray:
    """(2P, P): least squares over taps with motions (N, P, 2) px and indentations (N, P) mm, as if the pins were off by NOISE."""
    given = motion.reshape(len(motion), -1)
    ridge = len(given) * (NOISE * lattice.spacing) ** 2 * np.eye(given.shape[1])
    return np.linalg.solve(given.T @ given + ridge, given.T @ indentation)


def of_compliance(sensor: Sensor, camera: Camera, preprocess: Preprocess) -> np.ndarray:
    """(2P, P): the likeliest indentation where any force on any contact node is as likely as any other: learns from no contact."""
    moved, pressed = pins_per_force(sensor, camera, preprocess), per_force(sensor)
    spread = moved @ moved.T
    noise = np.trace(spread) / len(spread) / SIGNAL**2
    return np.linalg.solve(spread + noise * np.eye(len(spread)), moved @ pressed.T)


def pins_per_force(sensor: Sensor, camera: Camera, preprocess: Preprocess) -> np.ndarray:
    """(2P, 3N) px/N: how far pins move in the image, per unit of force on each contact node, where they have not moved yet."""
    full = dome(sensor)

    def seen(tip: jax.Array) -> jax.Array:
        return to_image_px(camera, preprocess, project(camera, tip, sensor))

    slope = np.asarray(jax.vmap(jax.jacfwd(seen))(jnp.asarray(full.pins, jnp.float32)), float)
    return np.einsum("pij,pjn->pin", slope, full.g.reshape(len(slope), 3, -1)).reshape(2 * len(slope), -1)


def indentation_of(inverse: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """(N, P) mm of motions (N, P, 2) px; all zero where no skin is pressed in by FELT_MM, as nothing is touched there."""
    found = motion.reshape(len(motion), len(inverse)) @ inverse
    return np.where(found.max(axis=-1, keepdims=True, initial=0) < FELT_MM, 0.0, found)
