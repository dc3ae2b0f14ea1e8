"""Finds the pins of a camera's frames, and the contact that they show, without JAX.

`write_pin_module` writes one of two classes, with all that it uses, as a module beside an exported
file: `CameraPins` for networks over pins, `CameraImages` for networks over images.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear import __version__
from jaxunshear.apps.export.package_source import collect_source
from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.sensor_frame import SensorFrame
from jaxunshear.errors import UserError
from jaxunshear.files import write_bytes
from jaxunshear.inference.readers import (
    FrameTransforms,
    TouchReader,
    add_no_contact,
    judge_batch,
    learn_gauge,
    make_frame_transforms,
    make_steady_view,
    read_pins,
    turn_pose,
)
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.lattice import Lattice, make_lattice
from jaxunshear.perception.preprocess import Box, View, prepare_frame
from jaxunshear.perception.sensor_check import SensorAppearance
from jaxunshear.perception.touch import (
    TouchGauge,
    TouchWeights,
    make_scaled_gauge,
    may_touch_nothing,
    measure_touch,
)


class UntouchedDome(NamedTuple):
    """The pins of an untouched dome, from where touch is measured, and the scale of motions."""

    rest: np.ndarray  # (P, 2) px of the prepared image
    mm_per_px: float
    stiffness: float
    weights: TouchWeights

    def make_gauge(self, ring: np.ndarray, lost: tuple[int, ...]) -> TouchGauge:
        lattice = make_lattice(self.rest, ring, lost)
        return make_scaled_gauge(lattice, self.mm_per_px, self.stiffness, self.weights)


DATA = (SensorFrame, View, Box, Preprocess, SensorAppearance, TouchWeights, UntouchedDome)
HEADING = '''"""Finds the pins of a camera's frames for {name}. Written by jaxunshear {version}.

    reading = CAMERA.read(frame)  # (H, W), or (H, W, channels) in the order red, green, blue
    pose = session.run(["pose"], {inputs})  # then CAMERA.turn_pose, by name
    reading.reason, reading.touch  # such as "no contact"; contact, slip and shear by name

Needs numpy, scipy, scikit-image and threadpoolctl alone.
"""
'''


class CameraReading(NamedTuple):
    """The pins of a frame, and the contact that they show."""

    # of the exported file: pins (1, P, 2) px, float32, NaN where there is a reason; or the prepared
    # image (1, S, S), uint8, black where there is a reason
    inputs: np.ndarray
    pins: np.ndarray  # (P, 2) px of the prepared image, NaN for one that is not seen
    touch: dict[str, float]  # contact, slip and shear, by output
    reason: str  # why there is no pose; empty where there is one
    familiarity: float = 0.0  # in [0, 1]: less if pins are spaced otherwise than the model's


@dataclass(frozen=True, eq=False)
class CameraPins:
    """A camera, and what a model over pins knows of its sensor."""

    preprocess: Preprocess
    frame: SensorFrame
    model_rest: np.ndarray  # (P, 2) px, of the exported file
    appearance: SensorAppearance
    untouched: UntouchedDome

    @cached_property
    def lattice(self) -> Lattice:
        return self.frame.make_detection_lattice()

    @cached_property
    def transforms(self) -> FrameTransforms:
        return make_frame_transforms(self.frame.rest, self.model_rest)

    @cached_property
    def gauge(self) -> TouchGauge:
        return self.untouched.make_gauge(self.frame.ring, self.frame.lost)

    def read(self, frame: np.ndarray) -> CameraReading:
        """Read a frame (H, W) or (H, W, channels) of the camera, as `TrainedModel.predict` does."""
        nothing = np.full((1, *self.model_rest.shape), np.nan, np.float32)
        try:
            images = prepare_frame(self.preprocess, frame, self.frame.view)[None]
        except UserError as error:
            return CameraReading(nothing, nothing[0], {}, str(error))
        values, identified, pins = read_pins(self.lattice, self.frame, self.transforms, images)
        assert pins is not None
        judged = judge_batch(images, identified, self.appearance, force=False)
        touch = measure_touch(self.gauge, pins)
        reason = str(add_no_contact(judged.rejection, touch, force=False)[0])
        inputs = nothing if reason else values
        familiarity = float(judged.familiarity[0])
        return CameraReading(inputs, pins[0], touch.describe(0), reason, familiarity)

    def learn_rest_positions(self, frames: Sequence[np.ndarray]) -> "CameraPins":
        """Return the camera that measures touch from these frames, of an untouched dome.

        Raises UserError.
        """
        view = self.frame.view
        images = np.stack([prepare_frame(self.preprocess, frame, view) for frame in frames])
        pins = read_pins(self.lattice, self.frame, self.transforms, images).pins
        assert pins is not None
        rest = learn_gauge(self.gauge, pins).lattice.rest
        return replace(self, untouched=self.untouched._replace(rest=rest))

    def turn_pose(self, pose: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Turn poses of the file, by name, from the model's sensor to this camera's."""
        return turn_pose(pose, self.transforms.degrees)


@dataclass(frozen=True, eq=False)
class CameraImages:
    """A camera, and what a model over images knows of its sensor."""

    preprocess: Preprocess
    view: View | None  # None: the crop that the frames so far have in common
    appearance: SensorAppearance
    rest: np.ndarray  # (P, 2) px of the prepared image, against which pins are tracked
    ring: np.ndarray  # (P,)
    lost: tuple[int, ...]
    untouched: UntouchedDome

    @cached_property
    def find_view(self) -> Callable[[np.ndarray], View]:
        return make_steady_view(self.preprocess)

    @cached_property
    def reader(self) -> TouchReader:
        gauge = self.untouched.make_gauge(self.ring, self.lost)
        return TouchReader(make_lattice(self.rest, self.ring, self.lost), gauge)

    def prepare(self, frame: np.ndarray) -> np.ndarray:
        """Turn a frame (H, W) or (H, W, channels) into an image (S, S). Raises UserError."""
        return prepare_frame(self.preprocess, frame, self.view or self.find_view(frame))

    def read(self, frame: np.ndarray) -> CameraReading:
        """Read a frame (H, W) or (H, W, channels) of the camera, as `TrainedModel.predict` does."""
        try:
            return self.read_image(self.prepare(frame))
        except UserError as error:
            size = self.preprocess.size
            pins = np.full(self.rest.shape, np.nan)
            return CameraReading(np.zeros((1, size, size), np.uint8), pins, {}, str(error))

    def read_image(self, image: np.ndarray) -> CameraReading:
        """Read a prepared image (S, S) uint8 of 0 and 255."""
        images = image[None]
        judged = judge_batch(images, np.ones(1, bool), self.appearance, force=False)
        pins = self.reader.track(images)
        touch = self.reader.measure(images, pins)
        reasons = judged.rejection
        if may_touch_nothing(self.reader.gauge, judged.pins[0]):
            reasons = add_no_contact(reasons, touch, force=False)
        reason = str(reasons[0])
        inputs, familiarity = images * (not reason), float(judged.familiarity[0])
        return CameraReading(inputs, pins[0], touch.describe(0), reason, familiarity)

    def learn_rest_positions(self, frames: Sequence[np.ndarray]) -> "CameraImages":
        """Return the camera that measures touch from these frames, of an untouched dome.

        Raises UserError.
        """
        learnt = self.reader.learn_rest_positions(np.stack(list(map(self.prepare, frames))), None)
        rest = learnt.gauge.lattice.rest
        return replace(self, untouched=self.untouched._replace(rest=rest))

    def turn_pose(self, pose: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return poses of the file as they are: this camera's sensor stands as the model's."""
        return pose


def get_module_path(file: Path) -> Path:
    """Return the path of the module beside an exported file.

    Raises UserError if something else has that name.
    """
    path = file.with_name(f"{file.stem}_pins.py")
    if path.exists() and not path.read_bytes().startswith(HEADING.split("{")[0].encode()):
        raise UserError(f"{path} is there, and no module of an export: give another --out")
    return path


def describe_camera_pins(model: TrainedModel, model_rest: np.ndarray) -> CameraPins:
    """Describe the camera of a model with a frame, over pins that rest at (P, 2) px."""
    assert model.frame is not None
    untouched = _describe_untouched_dome(model)
    return CameraPins(model.preprocess, model.frame, model_rest, model.appearance, untouched)


def describe_camera_images(model: TrainedModel, view: View | None) -> CameraImages:
    """Describe the camera of a model over images; `view` has the crop of its frames, if known."""
    lattice, untouched = model.touch_reader.lattice, _describe_untouched_dome(model)
    pins = lattice.rest, lattice.ring, lattice.lost
    return CameraImages(model.preprocess, view, model.appearance, *pins, untouched)


def _describe_untouched_dome(model: TrainedModel) -> UntouchedDome:
    gauge = model.touch_reader.gauge
    return UntouchedDome(gauge.lattice.rest, gauge.mm_per_px, gauge.stiffness, gauge.weights)


def write_pin_module(camera: CameraPins | CameraImages, inputs: str, file: Path) -> Path:
    """Write the module that finds the pins of a camera beside an exported file; return its path.

    `inputs` is what the file takes: pins, image or frame.
    """
    given = f'"{inputs}": {"frame[None]" if inputs == "frame" else "reading.inputs"}'
    heading = HEADING.format(name=file.name, version=__version__, inputs=f"{{{given}}}")
    source = collect_source(type(camera), *DATA)
    path = get_module_path(file)
    write_bytes(path, f"{heading}\n{source}\n\nCAMERA = {_format(camera)}\n".encode())
    return path


def _format(value: object) -> str:
    """Format data as an expression of Python."""
    if isinstance(value, np.ndarray):
        return f"np.array({value.tolist()})".replace("nan", "np.nan")
    if is_dataclass(value):
        named = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "_asdict"):
        named = value._asdict()
    else:
        return repr(value)
    formatted = (f"{name}={_format(each)}" for name, each in named.items())
    return f"{type(value).__name__}({', '.join(formatted)})"
