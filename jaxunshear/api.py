"""A trained model in a few lines of Python.

>>> model = load_model("skin", like="recordings/edge/shear")     # or the folder of a finished run
>>> images = np.stack([model.prepare(frame) for frame in frames])
>>> model.unshear(images)                             # (B, S, S) in [0, 1]
>>> model.pose(images)["unsheared"]["edge_mm"]        # (B,)
>>> model.codes(images).pose                          # (B, F)

What the commands do with a model are functions, too: `servo`, `reconstruct`, `score_geometry`, `find_pins`.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.config.targets import Targets
from jaxunshear.data.recorded_pins import Pins, find_pins
from jaxunshear.downstream.geometry_scores import GeometryResult, score_geometry
from jaxunshear.downstream.object_reconstruction import ReconstructionResult, reconstruct
from jaxunshear.downstream.servo import ServoTask
from jaxunshear.downstream.servo_scores import ServoResult, servo
from jaxunshear.errors import Note, UserError
from jaxunshear.inference.perceiver import Perceiver, Predictions, find_pin_frame, load_perceiver
from jaxunshear.inference.perception import BATCH, run_in_batches
from jaxunshear.inference.suitability import learnt_note, suits_recordings
from jaxunshear.model_folders import find_model_folder, load_settings
from jaxunshear.models.dispatch import encode
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.posenet import unscale_outputs
from jaxunshear.models.weights import Tree
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.perception.sensor_check import NO_MINIMUM
from jaxunshear.training.checkpoint import has_model, load_best, read_net, read_slides

__all__ = [
    "Codes",
    "GeometryResult",
    "Model",
    "Pins",
    "ReconstructionResult",
    "ServoResult",
    "ServoTask",
    "find_pins",
    "load_model",
    "reconstruct",
    "score_geometry",
    "servo",
]


class Codes(NamedTuple):
    """Of B images, each code as a row of numbers."""

    pose: np.ndarray  # z_p, (B, F)
    shear: np.ndarray | None  # z_s, (B, G); None of weights without it, as released ones are


@dataclass(frozen=True)
class Model:
    """Networks that take binary images (B, S, S), uint8 of {0, 255} or bool, as `prepare` makes them. What they give for an image that is
    not understood is NaN: its pins are not those of the model's sensor or, where networks read pins, cannot be identified for sure."""

    folder: Path
    experiment: Experiment
    perceiver: Perceiver
    # what networks read -> both codes; None where nothing unshears
    encoder: Callable[[np.ndarray], tuple[Array, Array | None]] | None
    slide_targets: Targets = ()  # what the shear code says of the slide

    @property
    def size(self) -> int:
        """S, px."""
        return self.perceiver.preprocess.size

    def prepare(self, frame: np.ndarray) -> np.ndarray:
        """Turn a camera's frame into a binary image (S, S) uint8.

        The frame is (H, W) or (H, W, channels), of any number type. Colours are red, green, blue;
        OpenCV's are blue, green, red. Warns with a `Note` if these
        networks do not suit a camera: they learnt from simulated touches of one sensor alone, so
        their answers for other frames mean little. Raises UserError.
        """
        if not suits_recordings(self.experiment):
            warnings.warn(learnt_note(self.experiment), Note, stacklevel=2)
        return prepare_frame(self.perceiver.preprocess, frame, self.perceiver.view or View())

    def unshear(self, images: np.ndarray) -> np.ndarray:
        """(B, S, S) float32 in [0, 1]: as a tap at the same poses would appear. Raises UserError."""
        answers = self._predict(images)
        if answers.unsheared is None:
            raise UserError(
                f"{self.folder} holds no network that unshears: train {DISENTANGLED}, or load another model"
            )
        return answers.unsheared

    def pose(self, images: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
        """By way of reading and by quantity (mm and deg, in the frame of the labels that were learnt), (B,) each: of the images
        "as_recorded" and "unsheared", and "learnt" where a PoseNet of slides is there. Raises UserError."""
        answers = self._predict(images)
        if not answers.poses:
            raise UserError(f"{self.folder} holds no PoseNet: train posenet, or load another model")
        return answers.poses

    def codes(self, images: np.ndarray) -> Codes:
        """Pose code and shear code. Raises UserError."""
        if self.encoder is None:
            raise UserError(
                f"{self.folder} holds no network with codes: train {DISENTANGLED}, or load another model"
            )
        encoder = self.encoder

        def encode_known(part: np.ndarray) -> tuple[Array | None, ...]:
            seen = self.perceiver.read(part)
            known = jnp.asarray(self.perceiver.explain_rejections(part, seen) == "")[:, None]
            codes = encoder(seen.values)
            return tuple(
                z if z is None else jnp.where(known, z.reshape(len(z), -1), jnp.nan) for z in codes
            )

        return Codes(*self._in_batches(images, encode_known))

    def slide(self, images: np.ndarray) -> dict[str, np.ndarray]:
        """How far each image's contact slid and turned, mm and deg by quantity, (B,) each: as the simulated sensor feels it that the
        network learnt from, or as the recordings were labelled. Of what has slipped, which cannot be seen, it is what is likely.
        Raises UserError."""
        shear = self.codes(images).shear if self.slide_targets else None
        if shear is None:
            raise UserError(
                f"{self.folder}: its shear code was not taught the slide, or was left out: train with the loss slide"
            )
        outputs = jnp.asarray((shear[:, : len(self.slide_targets)] + 1) / 2)
        return {
            name: np.asarray(value)
            for name, value in unscale_outputs(outputs, self.slide_targets).items()
        }

    def _predict(self, images: np.ndarray) -> Predictions:
        return self._in_batches(images, self.perceiver.predict)

    def _in_batches(self, images: np.ndarray, run: Callable[[np.ndarray], Tree]) -> Tree:
        """A few images are not filled up to a full batch: to find their pins takes longer than to compile once more."""
        images = self._check_images(images)
        return run_in_batches(run, images, min(BATCH, len(images)))

    def _check_images(self, images: np.ndarray) -> np.ndarray:
        images = np.asarray(images)
        if images.ndim != 3 or images.shape[1:] != (self.size, self.size) or not len(images):
            raise UserError(
                f"images of shape {images.shape}: this model takes (B, {self.size}, {self.size}), B at least 1; `prepare` "
                "makes one of a camera's frame"
            )
        if images.dtype == bool:
            return images.astype(np.uint8) * np.uint8(255)
        if images.dtype != np.uint8 or not np.isin(images, (0, 255)).all():
            raise UserError(
                f"images of {images.dtype}: this model takes uint8 of 0 and 255 alone, or bool; `prepare` makes them"
            )
        return images


def load_model(name: str | Path, like: str | Path | None = None, force: bool = False) -> Model:
    """Load released weights by name, or the networks in the folder of a finished run.

    Networks over pins that learnt from simulation alone, such as `skin`, need `like`: a folder of
    at least 20 contacts of your sensor and camera. The mean over them shows where untouched pins
    are. Other networks do not use it. `force` also answers images that are not of the model's
    sensor. Raises UserError.
    """
    folder = find_model_folder(Path(name))
    experiment = load_settings(folder)
    frame = None if like is None else find_pin_frame(Path(like), experiment)
    encoder = None
    slides: Targets = ()
    if has_model(folder / DISENTANGLED):
        net = read_net(folder / DISENTANGLED)
        encoder = jit_for_inference(
            lambda variables, seen: encode(net, variables, seen), load_best(folder / DISENTANGLED)
        )
        slides = read_slides(folder / DISENTANGLED)
    network = load_perceiver(folder, experiment, True, frame)
    return Model(
        folder,
        experiment,
        network._replace(min_plausibility=NO_MINIMUM) if force else network,
        encoder,
        slides,
    )
