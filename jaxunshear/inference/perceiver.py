"""A trained model as a laboratory uses it: prepared frames in; unsheared images and poses out, whatever its networks read.

>>> perceive = load_perceiver(Path("runs/recorded"), experiment, recorded_too=True)
>>> answers = perceive.answer(images)                  # (B, S, S) uint8 of {0, 255}, prepared by perceive.preprocess
>>> answers.poses["unsheared"]["y_mm"]                 # (B,)
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
from jaxunshear.models.dispatch import predict, unshear
from jaxunshear.models.inference import jit_for_inference
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

AS_RECORDED, UNSHEARED, LEARNT = (
    "as_recorded",
    "unsheared",
    "learnt",
)  # learnt: by a PoseNet that learnt from slides
EDGE = "edge_deg"  # the target that turns with the image
NETWORKS = (DISENTANGLED, POSENET, POSENET_SHEARED)


PinTransform = Callable[[np.ndarray], np.ndarray]  # of pins (B, P, 2) px


class NetworkInputs(NamedTuple):
    """What networks are given of a batch."""

    values: (
        np.ndarray
    )  # images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px, NaN where one is not seen
    identified: np.ndarray  # (B,) whether pins were identified, or none are needed
    pins: np.ndarray | None = None  # (B, P, 2) px in the image, of networks over pins


class NetworkOutputs(NamedTuple):
    """What networks give for a batch, whether they understood it or not."""

    unsheared: np.ndarray | None  # (B, S, S) in [0, 1]
    poses: dict[str, dict[str, np.ndarray]]  # by way and target, (B,)
    pins: dict[str, np.ndarray]  # by way, (B, P, 2) px, of networks over pins alone


class Predictions(NamedTuple):
    """The same, all of it NaN where an image was not understood."""

    unsheared: np.ndarray | None
    poses: dict[str, dict[str, np.ndarray]]
    pins: dict[str, np.ndarray]
    rejection: np.ndarray  # (B,) of text: why an image was not understood; empty where it was


class Perceiver(NamedTuple):
    preprocess: Preprocess  # how frames are prepared for it
    view: View | None  # crop of the frames that it learnt from; None: each folder's own
    targets: tuple[str, ...]  # of the poses that it reads
    read: Callable[[np.ndarray], NetworkInputs]  # of images (B, S, S) uint8 of {0, 255}
    run: Callable[[NetworkInputs], NetworkOutputs]
    expected: SensorAppearance  # how its sensor appears in prepared images
    min_plausibility: float = MIN_PLAUSIBILITY  # plausibility of an image that is understood

    def explain_rejections(self, images: np.ndarray, seen: NetworkInputs) -> np.ndarray:
        """Say of each image (B, S, S) why it is not understood: (B,) of text, empty where it is."""
        likely = [
            1.0
            if self.min_plausibility == NO_MINIMUM
            else compute_plausibility(image, self.expected)
            for image in images
        ]
        return np.array(
            [
                explain_rejection(*each, self.min_plausibility)
                for each in zip(seen.identified.tolist(), likely, strict=True)
            ]
        )

    def predict(self, images: np.ndarray) -> Predictions:
        """Answer images (B, S, S) uint8 of {0, 255}."""
        seen = self.read(images)
        doubts, values = self.explain_rejections(images, seen), self.run(seen)

        def keep_known(value: np.ndarray) -> np.ndarray:
            return np.where((doubts == "").reshape(-1, *[1] * (value.ndim - 1)), value, np.nan)

        shown: NetworkOutputs = jax.tree.map(keep_known, values)
        return Predictions(shown.unsheared, shown.poses, shown.pins, doubts)


def load_perceiver(
    model: Path, experiment: Experiment, with_sheared_poses: bool, frame: SensorFrame | None = None
) -> Perceiver:
    """The networks in the folder of a run. Poses of images as they are are read only where `with_sheared_poses`. `frame` says where pins stand
    in the images that are to be read; networks over simulated pins need it. Raises UserError."""
    keep_freed_memory()
    wanted = [name for name in NETWORKS if has_model(model / name)]
    if not isinstance(experiment.paired, Recorded):
        wanted = [name for name in wanted if name != POSENET_SHEARED]
    if not wanted:
        raise UserError(
            f"{model} holds no trained network that unshears or reads poses: train one, or name another --model"
        )
    nets, variables, targets = load_networks(model, wanted)
    names = next(
        (list_target_names(targets[name]) for name in (POSENET, POSENET_SHEARED) if name in nets),
        (),
    )
    run = jit_for_inference(partial(_forward, nets, targets, with_sheared_poses), variables)
    learnt, expected = (
        load_training_frame(model, experiment),
        load_sensor_appearance(model, experiment),
    )
    if uses_pins(experiment):
        rest = None if learnt else np.asarray(next(iter(variables.values()))["batch_stats"]["rest"])
        frame = learnt or frame
        if frame is None:
            raise UserError(
                f"{model} reads pins of any sensor, but of contacts one by one no mean is known: {LIKE_REMEDY}"
            )
        return _make_pin_perceiver(experiment, run, names, frame, rest, expected)

    def read(images: np.ndarray) -> NetworkInputs:
        return NetworkInputs(scale_to_unit(images), np.ones(len(images), bool))

    def run_networks(seen: NetworkInputs) -> NetworkOutputs:
        after, poses = jax.device_get(run(seen.values))
        return NetworkOutputs(
            None if after is None else after[..., 0], _order_poses(poses, names), {}
        )

    return Perceiver(
        experiment.paired.preprocess,
        learnt.view if learnt else None,
        names,
        read,
        run_networks,
        expected,
    )


def load_training_frame(model: Path, experiment: Experiment) -> SensorFrame | None:
    """What the recordings that a model learnt from have in common; None where it learnt from simulated touches. Raises UserError."""
    return (
        parse_frame(read_object(model / FRAME)) if isinstance(experiment.paired, Recorded) else None
    )


def find_pin_frame(path: Path, experiment: Experiment) -> SensorFrame | None:
    """Where pins stand in recordings at `path`, for networks over simulated pins; None for others, which know. Raises UserError."""
    if isinstance(experiment.paired, Recorded) or not uses_pins(experiment):
        return None
    preprocess = experiment.paired.preprocess
    return find_recordings_frame(read_recordings(path, preprocess), preprocess, experiment.sensor)


def load_sensor_appearance(model: Path, experiment: Experiment) -> SensorAppearance:
    """How the sensor of a model appears in the images that are prepared for it: recorded, or as the simulator draws it."""
    if frame := load_training_frame(model, experiment):
        return measure_sensor_appearance(frame.rest, frame.size)
    return measure_sensor_appearance(
        compute_model_lattice(experiment).rest, experiment.paired.preprocess.size
    )


ForwardResult = tuple[Array | None, dict[str, dict[str, Array]]]


def _forward(
    nets: Json, targets: Json, recorded_too: bool, variables: Variables, seen: Array
) -> ForwardResult:
    """Of images (B, S, S, 1) in [0, 1], or pins (B, P, 2) px: unsheared ones, or None, and poses by way."""

    def pose(name: str, given: Array) -> dict[str, Array]:
        return posenet.unscale_outputs(predict(nets[name], variables[name], given), targets[name])

    after = (
        unshear(nets[DISENTANGLED], variables[DISENTANGLED], seen) if DISENTANGLED in nets else None
    )
    poses = {}
    if POSENET in nets and (recorded_too or after is None):
        poses[AS_RECORDED] = pose(POSENET, seen)
    if POSENET in nets and after is not None:
        poses[UNSHEARED] = pose(POSENET, after)
    if POSENET_SHEARED in nets:
        poses[LEARNT] = pose(POSENET_SHEARED, seen)
    return after, poses


def _order_poses(
    poses: dict[str, dict[str, np.ndarray]], names: tuple[str, ...]
) -> dict[str, dict[str, np.ndarray]]:
    """In the order of the targets, which a compiled program forgets."""
    return {way: {name: pose[name] for name in names} for way, pose in poses.items()}


def _make_pin_perceiver(
    experiment: Experiment,
    run: Callable[..., Tree],
    names: tuple[str, ...],
    frame: SensorFrame,
    rest: np.ndarray | None,
    expected: SensorAppearance,
) -> Perceiver:
    """Pins are found and followed first; what comes out is drawn as dots. `rest` (P, 2) px are the places of pins that the networks know,
    where these are not the frame's."""
    lattice = make_lattice(to_detection_px(frame, frame.rest), frame.ring)
    there, back, degrees = make_frame_transforms(frame.rest, frame.rest if rest is None else rest)

    def read(images: np.ndarray) -> NetworkInputs:
        motion, sure = track_images(lattice, images, independent=True)
        pins = to_image_px(frame, lattice.rest + motion)
        return NetworkInputs(there(pins).astype(np.float32), sure, pins)

    def run_networks(seen: NetworkInputs) -> NetworkOutputs:
        assert seen.pins is not None
        after, poses = jax.device_get(run(seen.values))
        places, drawn = {AS_RECORDED: seen.pins}, None
        if after is not None:
            places[UNSHEARED] = back(after)
            drawn = np.asarray(
                draw_dots(jnp.asarray(places[UNSHEARED]), frame.radius_px, frame.size)
            )[..., 0]
        for pose in poses.values():
            if EDGE in pose:
                pose[EDGE] = wrap_degrees(pose[EDGE] + degrees)
        return NetworkOutputs(drawn, _order_poses(poses, names), places)

    preprocess = replace(experiment.paired.preprocess, size=frame.pins_px)
    return Perceiver(preprocess, frame.view, names, read, run_networks, expected)


def make_frame_transforms(
    here: np.ndarray, known: np.ndarray
) -> tuple[PinTransform, PinTransform, float]:
    """From pins (B, P, 2) px that stand at `here` (P, 2) to those that stand at `known`, back again, and by how many degrees the former
    are turned against the latter: pins' motions are turned and scaled as the two lattices are."""
    centred, target = here - here.mean(axis=0), known - known.mean(axis=0)
    turn, scale = orthogonal_procrustes(centred, target)
    scale = scale / np.square(centred).sum()
    degrees = float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))

    def there(pins: np.ndarray) -> np.ndarray:
        return known + scale * (pins - here) @ turn

    def back(pins: np.ndarray) -> np.ndarray:
        return here + (pins - known) @ turn.T / scale

    return there, back, degrees
