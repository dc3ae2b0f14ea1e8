"""What differs in an evaluation between networks over images and networks over pins."""

from typing import TypeVar

import jax
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.networks import PinNet, PinUnshear, UnshearNet
from jaxunshear.evaluation.score_collection import IMAGES, PINS
from jaxunshear.models import pin_networks, unshearnet
from jaxunshear.models.weights import Net, Variables

AnyArray = TypeVar("AnyArray", np.ndarray, Array)


class ImageModality:
    """Networks over images (B, S, S, 1). `PinModality` has the same members."""

    tap, sheared = IMAGES  # fields of a batch of pairs
    single_tap = "image"  # field of a batch of taps
    unit = "grey"  # of 1: unit of errors of reconstructions

    def scale(self, stored: AnyArray) -> AnyArray:
        """Scale what a data set stores to what a network takes."""
        return stored.astype(np.float32) / 255

    def has_shear_code(self, net: Net) -> bool:
        return isinstance(net, UnshearNet) and net.disentangled and net.shear_channels > 0

    def encode(self, net: Net, variables: Variables, inputs: Array) -> tuple[Array, Array | None]:
        """Encode scaled inputs to the pose code and the shear code."""
        return unshearnet.encode(net, variables, inputs)

    def decode_sheared(self, net: Net, variables: Variables, z_p: Array, z_s: Array) -> Array:
        """Reconstruct the scaled sheared input from both codes."""
        return jax.nn.sigmoid(unshearnet.decode_sheared(net, variables, z_p, z_s))

    def init(self, net: Net, variables: Variables, key: Array) -> Variables:
        """Draw new weights for the network that has `variables`."""
        return unshearnet.init(net, key)

    def make_example(self, net: Net, variables: Variables) -> np.ndarray:
        """Make one scaled input for timing: random dots."""
        dots = np.random.default_rng(0).random((1, net.size, net.size, 1)) < 0.2
        return dots.astype(np.float32)

    def compute_squared_errors(self, decoded: np.ndarray, true: np.ndarray) -> np.ndarray:
        """Compute the mean squared error (N,) of each reconstruction."""
        return np.square(decoded - true).mean(axis=(1, 2, 3))


class PinModality:
    """Networks over pins (B, P, 2) px."""

    tap, sheared = PINS
    single_tap = "pins"
    unit = "px"

    def scale(self, stored: AnyArray) -> AnyArray:
        return stored

    def has_shear_code(self, net: Net) -> bool:
        return isinstance(net, PinUnshear) and net.shear_code > 0

    def encode(self, net: Net, variables: Variables, inputs: Array) -> tuple[Array, Array | None]:
        return pin_networks.encode(net, variables, inputs)

    def decode_sheared(self, net: Net, variables: Variables, z_p: Array, z_s: Array) -> Array:
        return pin_networks.decode_sheared(net, variables, z_p, z_s)

    def init(self, net: Net, variables: Variables, key: Array) -> Variables:
        constants = variables["batch_stats"]
        return pin_networks.init(net, constants["rest"], constants["spread"], key)

    def make_example(self, net: Net, variables: Variables) -> np.ndarray:
        """Return the rest positions."""
        return np.asarray(variables["batch_stats"]["rest"])[None]

    def compute_squared_errors(self, decoded: np.ndarray, true: np.ndarray) -> np.ndarray:
        return np.square(decoded - true).sum(-1).mean(axis=1)


Modality = ImageModality | PinModality


def get_modality(experiment: Experiment) -> Modality:
    """Return the modality of the networks that an experiment evaluates."""
    return PinModality() if uses_pins(experiment) else ImageModality()


def get_net_modality(net: Net) -> Modality:
    """Return the modality of a network."""
    return PinModality() if isinstance(net, PinNet) else ImageModality()
