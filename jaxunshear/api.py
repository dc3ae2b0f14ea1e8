"""A trained model in a few lines of Python.

>>> model = load_model("skin", like="recordings/edge/shear")     # or the folder of a finished run
>>> images = np.stack([model.prepare(frame) for frame in frames])
>>> model.unshear(images)                             # (B, S, S) in [0, 1]
>>> model.pose(images)["unsheared"]["edge_mm"]        # (B,)
>>> model.codes(images).pose                          # (B, F)

The commands that use a model are functions, too: `servo`, `reconstruct`, `score_geometry`,
`find_pins`.
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
from jaxunshear.inference.suitability import describe_training, suits_recordings
from jaxunshear.model_folders import find_model_folder, load_settings
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.posenet import unscale_outputs
from jaxunshear.models.registry import encode
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
    """Latent codes of B images, each code as a row of numbers."""

    pose: np.ndarray  # z_p, (B, F)
    shear: np.ndarray | None  # z_s, (B, G); None for weights without it, such as released ones


@dataclass(frozen=True)
class Model:
    """Networks for binary images (B, S, S), uint8 of {0, 255} or bool, from `prepare`.

    Results are NaN for images that are rejected: their pins are not those of the model's sensor
    or, for pin networks, cannot be identified.
    """

    folder: Path
    experiment: Experiment
    perceiver: Perceiver
    # network inputs -> both codes; None if no network unshears
    encoder: Callable[[np.ndarray], tuple[Array, Array | None]] | None
    slide_targets: Targets = ()  # components of the slide that the shear code predicts

    @property
    def size(self) -> int:
        """S, px."""
        return self.perceiver.preprocess.size

    def prepare(self, frame: np.ndarray) -> np.ndarray:
        """Turn a camera frame into a binary image (S, S) uint8.

        The frame is (H, W) or (H, W, channels), of any number type. Colours are red, green, blue;
        OpenCV's are blue, green, red. Warns with a `Note` if these networks do not suit a camera:
        they were trained on simulated contacts of one sensor alone, so their predictions for other
        frames mean little. Raises UserError.
        """
        if not suits_recordings(self.experiment):
            warnings.warn(describe_training(self.experiment), Note, stacklevel=2)
        return prepare_frame(self.perceiver.preprocess, frame, self.perceiver.view or View())

    def unshear(self, images: np.ndarray) -> np.ndarray:
        """Predict the images of taps at the same poses, (B, S, S) float32 in [0, 1].

        Raises UserError if the model has no such network.
        """
        predictions = self._predict(images)
        if predictions.unsheared is None:
            raise UserError(
                f"{self.folder} holds no network that unshears: "
                f"train {DISENTANGLED}, or load another model"
            )
        return predictions.unsheared

    def pose(self, images: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
        """Predict poses by kind of input and by quantity, (B,) each.

        They are in mm and deg, in the frame of the training labels. Kinds are "as_recorded" and
        "unsheared", and "learnt" if there is a PoseNet of slides. Raises UserError if the model has
        no PoseNet.
        """
        predictions = self._predict(images)
        if not predictions.poses:
            raise UserError(f"{self.folder} holds no PoseNet: train posenet, or load another model")
        return predictions.poses

    def codes(self, images: np.ndarray) -> Codes:
        """Compute pose code and shear code. Raises UserError if the model has no codes."""
        if self.encoder is None:
            raise UserError(
                f"{self.folder} holds no network with codes: "
                f"train {DISENTANGLED}, or load another model"
            )
        encoder = self.encoder

        def encode_batch(batch: np.ndarray) -> tuple[Array | None, ...]:
            inputs = self.perceiver.read(batch)
            rejection = self.perceiver.explain_rejections(batch, inputs)
            accepted = jnp.asarray(rejection == "")[:, None]
            return tuple(
                code if code is None else jnp.where(accepted, code.reshape(len(code), -1), jnp.nan)
                for code in encoder(inputs.values)
            )

        return Codes(*self._run_in_batches(images, encode_batch))

    def slide(self, images: np.ndarray) -> dict[str, np.ndarray]:
        """Predict how far each contact slid and rotated, mm and deg by quantity, (B,) each.

        It is in the frame of the simulated sensor that the network was trained on, or as the
        recordings were labelled. Slip cannot be seen, so its likely value is included. Raises
        UserError if the shear code was not trained to predict slides.
        """
        shear = self.codes(images).shear if self.slide_targets else None
        if shear is None:
            raise UserError(
                f"{self.folder}: its shear code was not taught the slide, or was left out: "
                "train with the loss slide"
            )
        outputs = jnp.asarray((shear[:, : len(self.slide_targets)] + 1) / 2)
        slides = unscale_outputs(outputs, self.slide_targets)
        return {name: np.asarray(value) for name, value in slides.items()}

    def _predict(self, images: np.ndarray) -> Predictions:
        return self._run_in_batches(images, self.perceiver.predict)

    def _run_in_batches(self, images: np.ndarray, run: Callable[[np.ndarray], Tree]) -> Tree:
        images = self._check_images(images)
        # finding pins in blank images of a full batch takes longer than to compile once more
        return run_in_batches(run, images, min(BATCH, len(images)))

    def _check_images(self, images: np.ndarray) -> np.ndarray:
        images = np.asarray(images)
        if images.ndim != 3 or images.shape[1:] != (self.size, self.size) or not len(images):
            raise UserError(
                f"images of shape {images.shape}: this model takes (B, {self.size}, {self.size}), "
                "B at least 1; `prepare` makes one of a camera's frame"
            )
        if images.dtype == bool:
            return images.astype(np.uint8) * np.uint8(255)
        if images.dtype != np.uint8 or not np.isin(images, (0, 255)).all():
            raise UserError(
                f"images of {images.dtype}: this model takes uint8 of 0 and 255 alone, or bool; "
                "`prepare` makes them"
            )
        return images


def load_model(name: str | Path, like: str | Path | None = None, force: bool = False) -> Model:
    """Load released weights by name, or the networks in the folder of a finished run.

    Pin networks that were trained on simulation alone, such as `skin`, need `like`: a folder of at
    least 20 contacts of your sensor and camera. Their mean gives the rest positions of the pins.
    Other networks do not use it. `force` also accepts images that are not of the model's sensor.
    Raises UserError.
    """
    folder = find_model_folder(Path(name))
    experiment = load_settings(folder)
    frame = None if like is None else find_pin_frame(Path(like), experiment)
    encoder = None
    slide_targets: Targets = ()
    if has_model(folder / DISENTANGLED):
        net = read_net(folder / DISENTANGLED)
        encoder = jit_for_inference(
            lambda variables, inputs: encode(net, variables, inputs),
            load_best(folder / DISENTANGLED),
        )
        slide_targets = read_slides(folder / DISENTANGLED)
    perceiver = load_perceiver(folder, experiment, True, frame)
    if force:
        perceiver = perceiver._replace(min_plausibility=NO_MINIMUM)
    return Model(folder, experiment, perceiver, encoder, slide_targets)
