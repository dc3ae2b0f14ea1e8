"""A trained model, for binary images of a sensor.

>>> model = load_model("skin", like="recordings/edge/shear")     # or the folder of a finished run
>>> images = np.stack([model.prepare(frame) for frame in frames])
>>> model.unshear(images)                             # (B, S, S) in [0, 1]
>>> model.pose(images)["unsheared"]["edge_mm"]        # (B,)
>>> model.codes(images).pose                          # (B, F)
>>> model.predict(images).rejection                   # (B,) why the results of an image are NaN
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import ALL_NETWORKS, DISENTANGLED, POSENET, POSENET_SHEARED
from jaxunshear.config.sensor import Preprocess, Sensor
from jaxunshear.config.serialization import find_model_folder, load_task_settings
from jaxunshear.config.targets import list_target_names
from jaxunshear.data.recordings import read_recordings
from jaxunshear.data.sensor_frame import (
    LIKE_REMEDY,
    SensorFrame,
    find_recordings_frame,
    parse_frame,
)
from jaxunshear.data.sources import DataSource, open_source
from jaxunshear.environment import keep_freed_memory
from jaxunshear.errors import Note, UserError
from jaxunshear.files import read_object
from jaxunshear.inference.forward import (
    BATCH,
    RunNetworks,
    compile_networks,
    jit_for_inference,
)
from jaxunshear.inference.readers import (
    Codes,
    ImageReader,
    PinReader,
    Poses,
    PredictedBatch,
    Predictions,
    Reader,
    TouchReader,
    add_no_contact,
    check_images,
    compute_confidences,
    judge_batch,
    make_pin_reader,
    make_steady_view,
    make_touch_reader,
)
from jaxunshear.models.posenet import unscale_outputs
from jaxunshear.models.registry import encode, run_in_batches, scale_inputs
from jaxunshear.models.weights import Tree
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.perception.sensor_check import SensorAppearance, measure_sensor_appearance
from jaxunshear.perception.touch import Touch
from jaxunshear.training.checkpoint import TrainedNetwork, has_model, load_network, read_slides
from jaxunshear.training.examples import FRAME

PREFERRED_POSENETS = (POSENET, POSENET_SHEARED)


@dataclass(eq=False, repr=False)
class TrainedModel:
    """Networks for binary images (B, S, S), uint8 of {0, 255} or bool, from `prepare`.

    Results are NaN for images that are rejected: their pins do not match the model's sensor or, for
    pin networks, cannot be identified, or they show no contact. Networks are loaded when they are
    first used, and kept: load the model again after a training. Raises UserError if one is missing,
    damaged or not finished.
    """

    folder: Path
    experiment: Experiment
    # common to the frames to be read: of the training recordings, or of a folder that is like them
    frame: SensorFrame | None = None
    force: bool = False  # use images of another sensor, and of an untouched dome
    with_sheared_poses: bool = True  # `predict` poses of the images as they are, too
    compile_networks: Callable[[dict[str, TrainedNetwork], bool], RunNetworks] = compile_networks
    _loaded: dict[str, TrainedNetwork] = field(default_factory=dict, init=False)

    def __repr__(self) -> str:
        return f"TrainedModel({self.folder}: {', '.join(self.networks)})"

    @property
    def sensor(self) -> Sensor:
        return self.experiment.sensor

    @cached_property
    def source(self) -> DataSource:
        """The contacts that it was trained on."""
        return open_source(self.experiment)

    @property
    def reads_pins(self) -> bool:
        return self.experiment.unshear.input == "pins"

    def require_simulation(self, what: str) -> PairedData:
        """Return the simulated contacts that it was trained on.

        Raises UserError if it was trained on recordings, which `what` cannot use.
        """
        return self.experiment.paired.require_simulation(what)

    @property
    def networks(self) -> tuple[str, ...]:
        """The names of its trained networks."""
        return tuple(name for name in ALL_NETWORKS if has_model(self.folder / name))

    def load_network(self, name: str) -> TrainedNetwork:
        """Load a network, once. Raises UserError."""
        if name not in self._loaded:
            self._loaded[name] = load_network(self.folder / name)
        return self._loaded[name]

    @cached_property
    def _main_networks(self) -> dict[str, TrainedNetwork]:
        # a PoseNet of simulated slides is for comparisons alone
        posenets = PREFERRED_POSENETS if self.source.predicts_directly else (POSENET,)
        names = [name for name in (DISENTANGLED, *posenets) if name in self.networks]
        networks = {name: self.load_network(name) for name in names}
        if not networks:
            raise UserError(
                f"{self.folder} holds no trained network that unshears or reads poses: "
                "train one, or name another --model"
            )
        return networks

    @cached_property
    def targets(self) -> tuple[str, ...]:
        """The quantities of predicted poses; none without a PoseNet."""
        networks = self._main_networks
        for name in PREFERRED_POSENETS:
            if name in networks:
                return list_target_names(networks[name].targets)
        return ()

    @cached_property
    def lattice(self) -> Lattice:
        """Where pins rest in the images of the simulated sensor."""
        paired = self.require_simulation("this")
        return compute_rest_lattice(self.sensor, paired.camera, paired.preprocess)

    @property
    def rest(self) -> np.ndarray:
        """Where untouched pins stand in its prepared images, (P, 2) px."""
        return self.frame.rest if self.source.has_frame and self.frame else self.lattice.rest

    @cached_property
    def appearance(self) -> SensorAppearance:
        """How its sensor appears in prepared images: those of the camera, if its frame is known."""
        rest = self.frame.rest if self.frame else self.rest
        return measure_sensor_appearance(rest, self.experiment.paired.preprocess.size)

    @cached_property
    def touch_reader(self) -> TouchReader:
        """What measures contact, slip and shear, whatever the networks."""
        return make_touch_reader(self.frame or self.lattice, self.sensor)

    @cached_property
    def reader(self) -> Reader:
        """How images become inputs of the networks, and outputs become images."""
        if not self.reads_pins:
            return ImageReader()
        frame = self._require_frame()
        if self.source.has_frame:
            return make_pin_reader(frame, frame.rest)
        variables = next(iter(self._main_networks.values())).variables
        return make_pin_reader(frame, np.asarray(variables["batch_stats"]["rest"]))

    @cached_property
    def simulated_reader(self) -> Reader:
        """For images of the simulated sensor that it was trained on."""
        return PinReader(self.lattice) if self.reads_pins else ImageReader()

    def _require_frame(self) -> SensorFrame:
        if self.frame is None:
            raise UserError(
                f"{self.folder} reads pins of any sensor, "
                f"but of contacts one by one no mean is known: {LIKE_REMEDY}"
            )
        return self.frame

    @property
    def view(self) -> View | None:
        """The crop of the frames; None if each folder has its own."""
        return self.frame.view if self.frame else None

    @cached_property
    def find_view(self) -> Callable[[np.ndarray], View]:
        """A function from a camera's frames, one by one, to the view of those so far."""
        return make_steady_view(self.experiment.paired.preprocess)

    @property
    def preprocess(self) -> Preprocess:
        """How frames are prepared."""
        preprocess = self.experiment.paired.preprocess
        if not self.reads_pins:
            return preprocess
        return replace(preprocess, size=self._require_frame().pins_px)

    @property
    def size(self) -> int:
        return self.preprocess.size  # S, px

    def prepare(self, frame: np.ndarray) -> np.ndarray:
        """Turn a camera frame into a binary image (S, S) uint8.

        The frame is (H, W) or (H, W, channels), of any number type. Colours are red, green, blue;
        OpenCV's are blue, green, red. The crop is that of the training, or the median over this
        model's first frames, as `stream` has it. Warns with a `Note` if these networks learnt from
        one simulated sensor, so that their predictions mean little. Raises UserError.
        """
        if not self.source.suits_recordings:
            warnings.warn(self.source.describe(), Note, stacklevel=2)
        return prepare_frame(self.preprocess, frame, self.view or self.find_view(frame))

    def unshear(self, images: np.ndarray) -> np.ndarray:
        """Predict images of taps, (B, S, S) in [0, 1]. Raises UserError without such a network."""
        unsheared = self.predict(images).unsheared
        if unsheared is None:
            raise UserError(
                f"{self.folder} has no network named {DISENTANGLED}, which unshears: "
                "train it, or load another model"
            )
        return unsheared

    def pose(self, images: np.ndarray) -> Poses:
        """Predict poses, mm and deg by kind of input and by quantity, (B,) each.

        Kinds are "as_recorded" and "unsheared", and "learnt" if there is a PoseNet of slides.
        Raises UserError if the model has no PoseNet.
        """
        poses = self.predict(images).poses
        if not poses:
            raise UserError(f"{self.folder} holds no PoseNet: train posenet, or load another model")
        return poses

    def codes(self, images: np.ndarray) -> Codes:
        """Compute both codes, without a test for contact. Raises UserError if there are none."""
        if (run := self._encode) is None:
            raise UserError(
                f"{self.folder} holds no network with codes: "
                f"train {DISENTANGLED}, or load another model"
            )

        def encode_batch(batch: np.ndarray) -> tuple[Array | None, ...]:
            inputs = self.reader.read(batch)
            judged = judge_batch(batch, inputs.identified, self.appearance, self.force)
            accepted = jnp.asarray(judged.rejection == "")[:, None]
            return tuple(
                code if code is None else jnp.where(accepted, code.reshape(len(code), -1), jnp.nan)
                for code in run(scale_inputs(inputs.values))
            )

        return Codes(*self._run_in_batches(images, encode_batch))

    def slide(self, images: np.ndarray) -> dict[str, np.ndarray]:
        """Predict how far each contact slid and rotated, mm and deg by quantity, (B,) each.

        It is in the frame of the simulated sensor of the training, or of the labels of recordings.
        There is no test for contact. Raises UserError if the shear code does not predict slides.
        """
        targets = read_slides(self.folder / DISENTANGLED) if self._encode else ()
        shear = self.codes(images).shear if targets else None
        if shear is None:
            raise UserError(
                f"{self.folder}: its shear code was not taught the slide, or was left out: "
                "train with the loss slide"
            )
        outputs = jnp.asarray((shear[:, : len(targets)] + 1) / 2)
        return {name: np.asarray(v) for name, v in unscale_outputs(outputs, targets).items()}

    def touch(self, images: np.ndarray) -> Touch:
        """Measure contact, slip, shear and strain, (B,) each, by the pins' motion alone."""
        measure, read = self.touch_reader.measure, self.reader.read
        return self._run_in_batches(images, lambda batch: measure(batch, read(batch).pins))

    def learn_rest_positions(self, images: np.ndarray) -> None:
        """Measure touch from where pins stand in images of the untouched dome."""
        pins = self.reader.read(check_images(images, self.size)).pins
        self.touch_reader = self.touch_reader.learn_rest_positions(images, pins)

    def predict(self, images: np.ndarray) -> Predictions:
        """Unshear and predict poses, with a confidence, or a reason why there are none."""
        batch = self._run_in_batches(images, self._predict_batch)
        # networks over images need no pins, and tracking these takes as long as all else
        rest = ~batch.measured
        left = check_images(images, self.size)[rest]  # a copy: a camera reuses its array
        measure_touch = cache(partial(self.touch_reader.measure_rows, left, rest, batch.touch))
        poses = {}
        for kind, pose in batch.poses.items():  # JAX has sorted the quantities by name
            poses[kind] = {name: pose[name] for name in self.targets if name in pose}
        answers = batch.unsheared, poses, batch.pins, batch.rejection, batch.confidence
        return Predictions(*answers, measure_touch)

    def _predict_batch(self, images: np.ndarray) -> PredictedBatch:
        inputs = self.reader.read(images)
        judged = judge_batch(images, inputs.identified, self.appearance, self.force)
        touch, measured = self.touch_reader.measure_some(images, inputs.pins, judged, self.force)
        reasons = add_no_contact(judged.rejection, touch, self.force)
        unsheared, poses = jax.device_get(self._forward(scale_inputs(inputs.values)))
        outputs = self.reader.finish(inputs, unsheared, poses)

        def keep_accepted_rows(value: np.ndarray) -> np.ndarray:
            accepted = (reasons == "").reshape(-1, *[1] * (value.ndim - 1))
            return np.where(accepted, value, np.nan)

        resemblance = judged.plausibility * judged.familiarity
        confidence = resemblance * compute_confidences(outputs.unsheared) * (reasons == "")
        unsheared, poses, pins = jax.tree.map(keep_accepted_rows, outputs)
        return PredictedBatch(unsheared, poses, pins, reasons, confidence, touch, measured)

    def compile(self, batch: int) -> None:
        """Load the networks and compile them for this many images."""
        self.predict(np.zeros((batch, self.size, self.size), np.uint8))

    @cached_property
    def _forward(self) -> RunNetworks:
        return self.compile_networks(self._main_networks, self.with_sheared_poses)

    @cached_property
    def _encode(self) -> Callable[[np.ndarray], tuple[Array, Array | None]] | None:
        if DISENTANGLED not in self.networks:
            return None
        net, variables, _ = self.load_network(DISENTANGLED)
        return jit_for_inference(
            lambda variables, values: encode(net, variables, values), variables
        )

    def _run_in_batches(self, images: np.ndarray, run: Callable[[np.ndarray], Tree]) -> Tree:
        images = check_images(images, self.size)
        # finding pins in blank images of a full batch takes longer than to compile once more
        return run_in_batches(run, images, min(BATCH, len(images)))


def load_model(
    name: str | Path, like: str | Path | None = None, force: bool = False
) -> TrainedModel:
    """Load released weights by name, or the networks in the folder of a finished run.

    Pin networks that were trained on simulation alone, such as `skin`, need `like` to read frames
    of a camera: a folder of at least 20 contacts of your sensor and camera. Their mean gives the
    rest positions of the pins. Other networks do not use it. `force` also accepts images of another
    sensor and of an untouched dome. Raises UserError.
    """
    keep_freed_memory()
    folder = find_model_folder(Path(name))
    # networks are read when they are first used, perhaps from another working folder
    model = TrainedModel(folder.absolute(), load_task_settings(folder), force=force)
    if model.source.has_frame:
        model.frame = parse_frame(read_object(folder / FRAME))
    elif model.reads_pins and like is not None:
        preprocess = model.experiment.paired.preprocess
        recordings = read_recordings(like, preprocess)
        model.frame = find_recordings_frame(recordings, preprocess, model.sensor)
    return model
