"""Compute the rest positions of a simulated sensor's pins in its images."""

import jax.numpy as jnp
import numpy as np

from jaxunshear.config.sensor import Camera, Preprocess, Sensor
from jaxunshear.perception.lattice import Lattice, compute_rings, make_lattice
from jaxunshear.simulator.camera import project, to_image_px
from jaxunshear.simulator.pin_layout import compute_pin_tips


def compute_rest_lattice(sensor: Sensor, camera: Camera, preprocess: Preprocess) -> Lattice:
    """Compute the lattice, px of the prepared image, of a sensor that touches nothing."""
    px = project(camera, jnp.asarray(compute_pin_tips(sensor), jnp.float32), sensor)
    rest = np.asarray(to_image_px(camera, preprocess, px), float)
    return make_lattice(rest, compute_rings(sensor))
