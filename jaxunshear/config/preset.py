"""A sensor as `jaxunshear calibrate` fitted it -> a simulated experiment with that sensor.

>>> experiment = apply_preset(load_experiment("experiments/calibrated.py"), Path("calibration/calibration.json"))
"""

from dataclasses import dataclass, replace
from pathlib import Path

from jaxunshear.config.experiment import Experiment, require_simulated
from jaxunshear.config.image import Camera
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.serialization import build_value
from jaxunshear.errors import UserError
from jaxunshear.files import read_json


@dataclass(frozen=True)
class Preset:
    """What a calibration gives."""

    sensor: Sensor
    camera: Camera
    friction: float


def read_preset(file: Path) -> Preset:
    """The field `preset` of a calibration.json. Raises UserError."""
    if not file.is_file():
        raise UserError(
            f"--sensor-from {file} is no file: name a calibration.json of `jaxunshear calibrate`"
        )
    stored = read_json(file)
    if not isinstance(stored, dict) or "preset" not in stored:
        raise UserError(
            f"--sensor-from {file} holds no preset: name a calibration.json of `jaxunshear calibrate`"
        )
    return build_value(stored["preset"], Preset, f"--sensor-from {file}", "preset")


def apply_preset(experiment: Experiment, file: Path) -> Experiment:
    """`experiment` with the sensor, camera and friction in `file`; frames keep their number of pixels. Raises UserError."""
    paired, pose = require_simulated(experiment, "--sensor-from")
    preset = read_preset(file)
    camera = replace(preset.camera, frame_px=paired.camera.frame_px)
    return replace(
        experiment,
        sensor=preset.sensor,
        paired=replace(paired, camera=camera, friction=preset.friction),
        pose=replace(
            pose, camera=replace(camera, frame_px=pose.camera.frame_px), friction=preset.friction
        ),
    )
