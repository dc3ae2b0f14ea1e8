"""What networks take and give: images (B, S, S, 1), or pins (B, P, 2) px.

>>> modality = get_modality(experiment)  # IMAGES or PINS
>>> inputs = modality.scale(batch[modality.sheared])
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.losses import InputKind
from jaxunshear.data.reader import OTHER_IMAGE, OTHER_PINS, SWAPPED_IMAGE, SWAPPED_PINS
from jaxunshear.files import Json
from jaxunshear.models import distances, pin_networks
from jaxunshear.models.weights import AnyArray, Net, Variables
from jaxunshear.perception.drawing import draw_dots

Batch = Json


@dataclass(frozen=True)
class Modality:
    """The fields of batches that networks take, and how outputs are made, compared and drawn."""

    name: InputKind
    single: str  # field of contacts one by one: what a PoseNet takes
    canonical: str  # field of pairs: the taps
    sheared: str  # the slides
    other: str  # a contact at pose j after slide l
    swapped: str  # a contact at pose i after slide l; `sheared` is pose i after slide k
    unit: str  # of errors of reconstructions
    needs_identified_pins: bool  # contacts without them cannot be given to these networks
    scale: Callable[[AnyArray], AnyArray]  # what a data set stores -> what a network takes
    to_output: Callable[[Array], Array]  # what a decoder returns -> images in [0, 1], or pins px
    add_noise: Callable[[Net, Array, Array], Array]  # that of training; settings, inputs, key
    # what a decoder returns, what it should be, variables -> (B,)
    measure_distance: Callable[[Array, Array, Variables], Array]
    # outputs of a PoseNet (B, K), what they should be (B, K), weights (K,) -> (B,)
    compute_pose_loss: Callable[[Array, Array, tuple[float, ...]], Array]
    # reconstructions, scaled inputs -> (B,) in `unit` squared
    compute_squared_errors: Callable[[np.ndarray, np.ndarray], np.ndarray]
    # outputs, radius of a pin px, size of the image px -> images in [0, 1]
    draw: Callable[[Array, float, int], Array]
    make_example: Callable[[Net, Variables], np.ndarray]  # one scaled input, for timing

    @property
    def pair(self) -> tuple[str, str]:
        """The fields of taps and slides."""
        return self.canonical, self.sheared

    def prepare(self, batch: Batch) -> Batch:
        """Return the batch with scaled inputs."""
        fields = (self.single, self.canonical, self.sheared, self.other, self.swapped)
        return batch | {field: self.scale(batch[field]) for field in fields if field in batch}


def _scale_images(stored: AnyArray) -> AnyArray:
    """Turn uint8 {0, 255} into float32 {0, 1}; floats are taken as they are."""
    is_stored = np.issubdtype(stored.dtype, np.integer)
    return stored.astype(np.float32) / 255.0 if is_stored else stored


def _make_dots(net: Net, variables: Variables) -> np.ndarray:
    dots = np.random.default_rng(0).random((1, net.size, net.size, 1)) < 0.2
    return dots.astype(np.float32)


IMAGES = Modality(
    name="images",
    single="image",
    canonical="canonical",
    sheared="sheared",
    other=OTHER_IMAGE,
    swapped=SWAPPED_IMAGE,
    unit="grey",  # of 1
    needs_identified_pins=False,
    scale=_scale_images,
    to_output=jax.nn.sigmoid,
    add_noise=lambda net, images, key: images,
    measure_distance=lambda logits, target, variables: distances.compute_supervised_loss(
        jax.nn.sigmoid(logits), target
    ),
    compute_pose_loss=distances.compute_pose_loss,
    compute_squared_errors=lambda decoded, true: np.square(decoded - true).mean(axis=(1, 2, 3)),
    draw=lambda images, radius_px, size: images,
    make_example=_make_dots,
)
PINS = Modality(
    name="pins",
    single="pins",
    canonical="canonical_pins",
    sheared="sheared_pins",
    other=OTHER_PINS,
    swapped=SWAPPED_PINS,
    unit="px",
    needs_identified_pins=True,
    scale=lambda pins: pins,
    to_output=lambda pins: pins,
    add_noise=pin_networks.add_noise,
    measure_distance=distances.compute_pin_distance,
    compute_pose_loss=distances.compute_absolute_pose_loss,
    compute_squared_errors=lambda decoded, true: np.square(decoded - true).sum(-1).mean(axis=1),
    draw=draw_dots,
    make_example=lambda net, variables: np.asarray(variables["batch_stats"]["rest"])[None],
)
_MODALITIES = {modality.name: modality for modality in (IMAGES, PINS)}


def get_modality(experiment: Experiment) -> Modality:
    """Return the modality of the networks that an experiment evaluates."""
    return _MODALITIES[experiment.unshear.input]
