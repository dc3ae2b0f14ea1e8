"""What the inputs and outputs of a network are, as its losses need it: images or pins."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.config import losses as names
from jaxunshear.data.factorial import OTHER, OTHER_IMAGE, SWAPPED, SWAPPED_IMAGE
from jaxunshear.files import Json
from jaxunshear.models import pin_networks
from jaxunshear.models.weights import Variables
from jaxunshear.training import losses

Batch = Json


class Modality(NamedTuple):
    """Fields of a batch, and how outputs are made and compared."""

    name: names.InputKind
    canonical: str  # the field of the taps
    sheared: str  # of the slides
    other: str  # of other poses after other slides
    swapped: str  # of the slides' own poses after these other slides
    to_output: Callable[[Array], Array]  # what a decoder returns -> images in [0, 1], or pins px
    # what a decoder returns, a field of the batch, variables -> (B,)
    measure_distance: Callable[[Array, Array, Variables], Array]
    # outputs of a PoseNet (B, K), what they should be (B, K), weights (K,) -> (B,)
    compute_pose_loss: Callable[[Array, Array, tuple[float, ...]], Array]

    def prepare(self, batch: Batch) -> Batch:
        """Return the batch with images as floats in [0, 1]."""
        fields = (self.canonical, self.sheared, self.other, self.swapped)
        return batch | {field: to_unit(batch[field]) for field in fields if field in batch}


def to_unit(images: Array) -> Array:
    """Turn uint8 {0, 255} into float32 {0, 1}; floats are taken as they are."""
    if not jnp.issubdtype(images.dtype, jnp.integer):
        return images
    return images.astype(jnp.float32) / 255.0


def _measure_image_distance(logits: Array, target: Array, variables: Variables) -> Array:
    return losses.compute_supervised_loss(jax.nn.sigmoid(logits), target)


IMAGES = Modality(
    "images",
    "canonical",
    "sheared",
    OTHER_IMAGE,
    SWAPPED_IMAGE,
    jax.nn.sigmoid,
    _measure_image_distance,
    losses.compute_pose_loss,
)
PINS = Modality(
    "pins",
    "canonical_pins",
    "sheared_pins",
    OTHER,
    SWAPPED,
    lambda pins: pins,
    pin_networks.compute_pin_distance,
    losses.compute_absolute_pose_loss,
)
