"""Where a simulated sensor's untouched pins lie in its images."""

import jax.numpy as jnp
import numpy as np

from jaxunshear.config.image import Camera, Preprocess
from jaxunshear.config.sensor import Sensor
from jaxunshear.perception.lattice import Lattice, compute_rings, make_lattice
from jaxunshear.simulator.camera import project, to_image_px
from jaxunshear.simulator.pin_layout import compute_pin_tips


def compute_rest_lattice(sensor: Sensor, camera: Camera, preprocess: Preprocess) -> Lattice:
    """The lattice of a sensor that touches nothing, seen through this camera and prepared like all frames."""
    px = project(camera, jnp.asarray(compute_pin_tips(sensor), jnp.float32), sensor)
    return make_lattice(
        np.asarray(to_image_px(camera, preprocess, px), float), compute_rings(sensor)
    )
