"""A trained model for prepared frames: unsheared images and poses.

Its networks take images or pins.

>>> perceiver = load_perceiver(Path("runs/recorded"), experiment, with_sheared_poses=True)
>>> predictions = perceiver.predict(images)    # (B, S, S) uint8 of {0, 255}, see its `preprocess`
>>> predictions.poses["unsheared"]["y_mm"]     # (B,)
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import orthogonal_procrustes

from jaxunshear.allocator import keep_freed_memory
from jaxunshear.angles import wrap_degrees
from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.image import Preprocess
from jaxunshear.config.registry import DISENTANGLED, POSENET, POSENET_SHEARED
from jaxunshear.config.targets import list_target_names
from jaxunshear.data.preprocessing import (
    LIKE_REMEDY,
    SensorFrame,
    find_recordings_frame,
    to_detection_px,
    to_image_px,
)
from jaxunshear.data.recorded_set import parse_frame
from jaxunshear.data.recordings import read_recordings
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object
from jaxunshear.inference.perception import compute_model_lattice, load_networks, scale_to_unit
from jaxunshear.models import posenet
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.registry import predict, unshear
from jaxunshear.models.weights import Tree, Variables
from jaxunshear.perception.lattice import make_lattice
from jaxunshear.perception.pin_drawing import draw_dots
from jaxunshear.perception.pin_tracking import track_images
from jaxunshear.perception.preprocess import View
from jaxunshear.perception.sensor_check import (
    MIN_PLAUSIBILITY,
    NO_MINIMUM,
    SensorAppearance,
    compute_plausibility,
    explain_rejection,
    measure_sensor_appearance,
)
from jaxunshear.training.checkpoint import has_model
from jaxunshear.training.examples import FRAME

AS_RECORDED, UNSHEARED = "as_recorded", "unsheared"
LEARNT = "learnt"  # poses by a PoseNet that was trained on slides
EDGE = "edge_deg"  # the target that rotates with the image
NETWORKS = (DISENTANGLED, POSENET, POSENET_SHEARED)

Poses = dict[str, dict[str, np.ndarray]]  # by kind of input and target, (B,)
PinTransform = Callable[[np.ndarray], np.ndarray]  # of pins (B, P, 2) px


class NetworkInputs(NamedTuple):
    """Inputs of networks for a batch."""

    # images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px, NaN if one was not detected
    values: np.ndarray
    identified: np.ndarray  # (B,) whether pins were identified, or none are needed
    pins: np.ndarray | None = None  # (B, P, 2) px in the image, for pin networks


class NetworkOutputs(NamedTuple):
    """Outputs of networks for a batch, also for images to be rejected."""

    unsheared: np.ndarray | None  # (B, S, S) in [0, 1]
    poses: Poses
    pins: dict[str, np.ndarray]  # by kind, (B, P, 2) px, of pin networks alone


class Predictions(NamedTuple):
    """Network outputs that are NaN for rejected images."""

    unsheared: np.ndarray | None
    poses: Poses
    pins: dict[str, np.ndarray]
    rejection: np.ndarray  # (B,) of text: why an image is rejected; empty if it is not


class Perceiver(NamedTuple):
    preprocess: Preprocess  # of the frames
    view: View | None  # crop of the training frames; None for each folder's own
    targets: tuple[str, ...]  # of the predicted poses
    read: Callable[[np.ndarray], NetworkInputs]  # of images (B, S, S) uint8 of {0, 255}
    run: Callable[[NetworkInputs], NetworkOutputs]
    expected: SensorAppearance  # of its sensor in prepared images
    min_plausibility: float = MIN_PLAUSIBILITY  # least plausibility of an accepted image

    def explain_rejections(self, images: np.ndarray, inputs: NetworkInputs) -> np.ndarray:
        """Say of each image (B, S, S) why it is rejected: (B,) of text, empty if it is not."""
        reasons = []
        for image, identified in zip(images, inputs.identified.tolist(), strict=True):
            plausibility = 1.0
            if self.min_plausibility != NO_MINIMUM:
                plausibility = compute_plausibility(image, self.expected)
            reasons.append(explain_rejection(identified, plausibility, self.min_plausibility))
        return np.array(reasons)

    def predict(self, images: np.ndarray) -> Predictions:
        """Unshear images (B, S, S) uint8 of {0, 255}, and predict their poses."""
        inputs = self.read(images)
        rejection, outputs = self.explain_rejections(images, inputs), self.run(inputs)

        def keep_accepted_rows(value: np.ndarray) -> np.ndarray:
            accepted = (rejection == "").reshape(-1, *[1] * (value.ndim - 1))
            return np.where(accepted, value, np.nan)

        outputs = jax.tree.map(keep_accepted_rows, outputs)
        return Predictions(outputs.unsheared, outputs.poses, outputs.pins, rejection)


def load_perceiver(
    model: Path, experiment: Experiment, with_sheared_poses: bool, frame: SensorFrame | None = None
) -> Perceiver:
    """Load the networks in the folder of a run. Raises UserError if there are none.

    Args:
        with_sheared_poses: Also predict the poses of images as they are.
        frame: The rest positions in the images to be read; networks over simulated pins need it.
    """
    keep_freed_memory()
    available = [name for name in NETWORKS if has_model(model / name)]
    if not isinstance(experiment.paired, Recorded):
        available = [name for name in available if name != POSENET_SHEARED]
    if not available:
        raise UserError(
            f"{model} holds no trained network that unshears or reads poses: "
            "train one, or name another --model"
        )
    nets, variables, targets = load_networks(model, available)
    pose_nets = [name for name in (POSENET, POSENET_SHEARED) if name in nets]
    names = list_target_names(targets[pose_nets[0]]) if pose_nets else ()
    run = jit_for_inference(partial(_forward, nets, targets, with_sheared_poses), variables)
    training_frame = load_training_frame(model, experiment)
    expected = load_sensor_appearance(model, experiment)
    if not uses_pins(experiment):
        view = training_frame.view if training_frame else None
        return _make_image_perceiver(experiment.paired.preprocess, view, names, run, expected)
    rest = None
    if training_frame is None:
        rest = np.asarray(next(iter(variables.values()))["batch_stats"]["rest"])
        training_frame = frame
    if training_frame is None:
        raise UserError(
            f"{model} reads pins of any sensor, "
            f"but of contacts one by one no mean is known: {LIKE_REMEDY}"
        )
    return _make_pin_perceiver(experiment, run, names, training_frame, rest, expected)


def load_training_frame(model: Path, experiment: Experiment) -> SensorFrame | None:
    """Load what the recordings that a model was trained on have in common.

    Returns None if it was trained on simulated contacts. Raises UserError.
    """
    if not isinstance(experiment.paired, Recorded):
        return None
    return parse_frame(read_object(model / FRAME))


def find_pin_frame(path: Path, experiment: Experiment) -> SensorFrame | None:
    """Find the rest positions in recordings at `path`, for networks over simulated pins.

    Returns None for other networks, which do not need them. Raises UserError.
    """
    if isinstance(experiment.paired, Recorded) or not uses_pins(experiment):
        return None
    preprocess = experiment.paired.preprocess
    return find_recordings_frame(read_recordings(path, preprocess), preprocess, experiment.sensor)


def load_sensor_appearance(model: Path, experiment: Experiment) -> SensorAppearance:
    """Load how the sensor of a model appears in prepared images, recorded or simulated."""
    if frame := load_training_frame(model, experiment):
        return measure_sensor_appearance(frame.rest, frame.size)
    return measure_sensor_appearance(
        compute_model_lattice(experiment).rest, experiment.paired.preprocess.size
    )


ForwardResult = tuple[Array | None, dict[str, dict[str, Array]]]


def _forward(
    nets: Json, targets: Json, with_sheared_poses: bool, variables: Variables, values: Array
) -> ForwardResult:
    """Unshear images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px, and predict poses by kind.

    The unsheared ones are None without a network that unshears.
    """

    def predict_pose(name: str, values: Array) -> dict[str, Array]:
        outputs = predict(nets[name], variables[name], values)
        return posenet.unscale_outputs(outputs, targets[name])

    unsheared = None
    if DISENTANGLED in nets:
        unsheared = unshear(nets[DISENTANGLED], variables[DISENTANGLED], values)
    poses = {}
    if POSENET in nets and (with_sheared_poses or unsheared is None):
        poses[AS_RECORDED] = predict_pose(POSENET, values)
    if POSENET in nets and unsheared is not None:
        poses[UNSHEARED] = predict_pose(POSENET, unsheared)
    if POSENET_SHEARED in nets:
        poses[LEARNT] = predict_pose(POSENET_SHEARED, values)
    return unsheared, poses


def _order_poses(poses: Poses, names: tuple[str, ...]) -> Poses:
    """Restore the order of the targets, which a compiled program loses."""
    ordered: Poses = {}
    for kind, pose in poses.items():
        ordered[kind] = {name: pose[name] for name in names}
    return ordered


def _make_image_perceiver(
    preprocess: Preprocess,
    view: View | None,
    names: tuple[str, ...],
    run: Callable[..., Tree],
    expected: SensorAppearance,
) -> Perceiver:
    def read(images: np.ndarray) -> NetworkInputs:
        return NetworkInputs(scale_to_unit(images), np.ones(len(images), bool))

    def run_networks(inputs: NetworkInputs) -> NetworkOutputs:
        unsheared, poses = jax.device_get(run(inputs.values))
        if unsheared is not None:
            unsheared = unsheared[..., 0]
        return NetworkOutputs(unsheared, _order_poses(poses, names), {})

    return Perceiver(preprocess, view, names, read, run_networks, expected)


def _make_pin_perceiver(
    experiment: Experiment,
    run: Callable[..., Tree],
    names: tuple[str, ...],
    frame: SensorFrame,
    rest: np.ndarray | None,
    expected: SensorAppearance,
) -> Perceiver:
    """Make a perceiver that detects and tracks pins first, and draws unsheared pins as dots.

    `rest` (P, 2) px are the rest positions of the training pins, if these are not the frame's.
    """
    lattice = make_lattice(to_detection_px(frame, frame.rest), frame.ring)
    transforms = make_frame_transforms(frame.rest, frame.rest if rest is None else rest)

    def read(images: np.ndarray) -> NetworkInputs:
        motion, identified = track_images(lattice, images, independent=True)
        pins = to_image_px(frame, lattice.rest + motion)
        return NetworkInputs(transforms.to_model(pins).astype(np.float32), identified, pins)

    def run_networks(inputs: NetworkInputs) -> NetworkOutputs:
        assert inputs.pins is not None
        unsheared, poses = jax.device_get(run(inputs.values))
        pins, image = {AS_RECORDED: inputs.pins}, None
        if unsheared is not None:
            pins[UNSHEARED] = transforms.from_model(unsheared)
            dots = draw_dots(jnp.asarray(pins[UNSHEARED]), frame.radius_px, frame.size)
            image = np.asarray(dots)[..., 0]
        for pose in poses.values():
            if EDGE in pose:
                pose[EDGE] = wrap_degrees(pose[EDGE] + transforms.degrees)
        return NetworkOutputs(image, _order_poses(poses, names), pins)

    preprocess = replace(experiment.paired.preprocess, size=frame.pins_px)
    return Perceiver(preprocess, frame.view, names, read, run_networks, expected)


class FrameTransforms(NamedTuple):
    """Between the pins of an image and those that networks were trained on."""

    to_model: PinTransform
    from_model: PinTransform
    degrees: float  # rotation of the image's lattice against the model's


def make_frame_transforms(image_rest: np.ndarray, model_rest: np.ndarray) -> FrameTransforms:
    """Fit the rotation and scale between two lattices (P, 2), which pins' motions follow."""
    centred = image_rest - image_rest.mean(axis=0)
    target = model_rest - model_rest.mean(axis=0)
    turn, scale = orthogonal_procrustes(centred, target)
    scale = scale / np.square(centred).sum()
    degrees = float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))

    def to_model(pins: np.ndarray) -> np.ndarray:
        return model_rest + scale * (pins - image_rest) @ turn

    def from_model(pins: np.ndarray) -> np.ndarray:
        return image_rest + (pins - model_rest) @ turn.T / scale

    return FrameTransforms(to_model, from_model, degrees)
