"""Finds the pins of a camera's frames for an exported file, without JAX.

`write_pin_module` writes this class, with all that it uses, as a module of its own.
"""

from collections.abc import Sequence
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
    add_no_contact,
    judge_batch,
    learn_gauge,
    make_frame_transforms,
    read_pins,
    turn_pose,
)
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.lattice import Lattice, make_lattice
from jaxunshear.perception.preprocess import Box, View, prepare_frame
from jaxunshear.perception.sensor_check import SensorAppearance
from jaxunshear.perception.touch import TouchGauge, TouchWeights, make_scaled_gauge, measure_touch

DATA = (SensorFrame, View, Box, Preprocess, SensorAppearance, TouchWeights)
HEADING = '''"""Finds the pins of a camera's frames for {name}. Written by jaxunshear {version}.

    reading = CAMERA.read(frame)  # (H, W), or (H, W, channels) in the order red, green, blue
    pose = session.run(["pose"], {{"pins": reading.inputs}})  # then CAMERA.turn_pose, by name

Needs numpy, scipy, scikit-image and threadpoolctl alone.
"""
'''


class CameraReading(NamedTuple):
    """The pins of a frame, and the contact that they show."""

    inputs: np.ndarray  # (1, P, 2) px, float32: of the exported file; NaN where there is a reason
    pins: np.ndarray  # (P, 2) px of the prepared image, NaN for one that is not seen
    touch: dict[str, float]  # contact, slip and shear, by output
    reason: str  # why there is no pose; empty where there is one


@dataclass(frozen=True, eq=False)
class CameraPins:
    """A camera, and what a model over pins knows of its sensor."""

    preprocess: Preprocess
    frame: SensorFrame
    model_rest: np.ndarray  # (P, 2) px, of the exported file
    appearance: SensorAppearance
    untouched: np.ndarray  # (P, 2) px of the prepared image, from where touch is measured
    mm_per_px: float
    stiffness: float
    weights: TouchWeights

    @cached_property
    def lattice(self) -> Lattice:
        return self.frame.make_detection_lattice()

    @cached_property
    def transforms(self) -> FrameTransforms:
        return make_frame_transforms(self.frame.rest, self.model_rest)

    @cached_property
    def gauge(self) -> TouchGauge:
        untouched = make_lattice(self.untouched, self.frame.ring)
        return make_scaled_gauge(untouched, self.mm_per_px, self.stiffness, self.weights)

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
        return CameraReading(nothing if reason else values, pins[0], touch.describe(0), reason)

    def learn_rest_positions(self, frames: Sequence[np.ndarray]) -> "CameraPins":
        """Return the camera that measures touch from these frames, of an untouched dome.

        Raises UserError.
        """
        view = self.frame.view
        images = np.stack([prepare_frame(self.preprocess, frame, view) for frame in frames])
        pins = read_pins(self.lattice, self.frame, self.transforms, images).pins
        assert pins is not None
        return replace(self, untouched=learn_gauge(self.gauge, pins).lattice.rest)

    def turn_pose(self, pose: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Turn poses of the file, by name, from the model's sensor to this camera's."""
        return turn_pose(pose, self.transforms.degrees)


def get_module_path(file: Path) -> Path:
    """Return the path of the module beside an exported file.

    Raises UserError if something else has that name.
    """
    path = file.with_name(f"{file.stem}_pins.py")
    if path.exists() and not path.read_bytes().startswith(HEADING.split("{")[0].encode()):
        raise UserError(f"{path} is there, and no module of an export: give another --out")
    return path


def write_pin_module(model: TrainedModel, model_rest: np.ndarray, file: Path) -> Path:
    """Write the module that finds the pins of a model's camera beside an exported file.

    Returns its path. The model has a frame, and networks over pins that rest at `model_rest` px.
    """
    assert model.frame is not None
    gauge = model.touch_reader.gauge
    camera = CameraPins(
        model.preprocess,
        model.frame,
        model_rest,
        model.appearance,
        gauge.lattice.rest,
        gauge.mm_per_px,
        gauge.stiffness,
        gauge.weights,
    )
    heading = HEADING.format(name=file.name, version=__version__)
    source = collect_source(CameraPins, *DATA)
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
