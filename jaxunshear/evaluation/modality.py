"""What differs in an evaluation between networks over images and networks over pins."""

from abc import ABC, abstractmethod
from typing import ClassVar

import jax
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.networks import PinNet, PinUnshear, UnshearNet
from jaxunshear.evaluation.score_collection import IMAGES, PINS
from jaxunshear.models import pin_networks, unshearnet
from jaxunshear.models.weights import Net, Variables


class Modality(ABC):
    """Input and output of networks: images (B, S, S, 1), or pins (B, P, 2) px.

    `tap` and `sheared` are the fields of a batch of pairs, `single_tap` is the field of a batch of
    taps, and errors of what a decoder reconstructs have the unit `unit`.
    """

    tap: ClassVar[str]
    sheared: ClassVar[str]
    single_tap: ClassVar[str]
    unit: ClassVar[str]

    @abstractmethod
    def scale(self, stored: ArrayLike) -> ArrayLike:
        """Scale what a data set stores to what a network takes."""

    @abstractmethod
    def has_shear_code(self, net: Net) -> bool:
        """Say whether the network is a disentangled one."""

    @abstractmethod
    def encode(self, net: Net, variables: Variables, inputs: Array) -> tuple[Array, Array | None]:
        """Encode scaled inputs to the pose code and the shear code."""

    @abstractmethod
    def decode_sheared(self, net: Net, variables: Variables, z_p: Array, z_s: Array) -> Array:
        """Reconstruct the sheared input, on the scale of `scale`, from both codes."""

    @abstractmethod
    def init(self, net: Net, variables: Variables, key: Array) -> Variables:
        """Draw new weights for the network that has `variables`."""

    @abstractmethod
    def make_example(self, net: Net, variables: Variables) -> np.ndarray:
        """Make one scaled input, to measure how long a network takes."""

    @abstractmethod
    def compute_squared_errors(self, decoded: np.ndarray, true: np.ndarray) -> np.ndarray:
        """Compute the mean squared error (N,) of each image, or of the pins of each contact."""


class _ImageModality(Modality):
    tap, sheared = IMAGES
    single_tap = "image"
    unit = "grey"  # of 1

    def scale(self, stored: ArrayLike) -> ArrayLike:
        return stored.astype(np.float32) / 255  # type: ignore[union-attr]

    def has_shear_code(self, net: Net) -> bool:
        return isinstance(net, UnshearNet) and net.disentangled and net.shear_channels > 0

    def encode(self, net: Net, variables: Variables, inputs: Array) -> tuple[Array, Array | None]:
        return unshearnet.encode(net, variables, inputs)

    def decode_sheared(self, net: Net, variables: Variables, z_p: Array, z_s: Array) -> Array:
        return jax.nn.sigmoid(unshearnet.decode_sheared(net, variables, z_p, z_s))

    def init(self, net: Net, variables: Variables, key: Array) -> Variables:
        return unshearnet.init(net, key)

    def make_example(self, net: Net, variables: Variables) -> np.ndarray:
        """Make one image of random dots."""
        dots = np.random.default_rng(0).random((1, net.size, net.size, 1)) < 0.2
        return dots.astype(np.float32)

    def compute_squared_errors(self, decoded: np.ndarray, true: np.ndarray) -> np.ndarray:
        return np.square(decoded - true).mean(axis=(1, 2, 3))


class _PinModality(Modality):
    tap, sheared = PINS
    single_tap = "pins"
    unit = "px"

    def scale(self, stored: ArrayLike) -> ArrayLike:
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
        """Return the rest positions of the pins."""
        return np.asarray(variables["batch_stats"]["rest"])[None]

    def compute_squared_errors(self, decoded: np.ndarray, true: np.ndarray) -> np.ndarray:
        return np.square(decoded - true).sum(-1).mean(axis=1)


IMAGE_MODALITY: Modality = _ImageModality()
PIN_MODALITY: Modality = _PinModality()


def get_modality(experiment: Experiment) -> Modality:
    """Return the modality of the networks that an experiment evaluates."""
    return PIN_MODALITY if uses_pins(experiment) else IMAGE_MODALITY


def get_net_modality(net: Net) -> Modality:
    """Return the modality of a network."""
    return PIN_MODALITY if isinstance(net, PinNet) else IMAGE_MODALITY
