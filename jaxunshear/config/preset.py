"""Give a simulated experiment the sensor that `jaxunshear calibrate` has fitted.

>>> experiment = load_experiment("experiments/calibrated.py")
>>> experiment = apply_preset(experiment, Path("calibration/calibration.json"))
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from jaxunshear.config.data import PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.image import Camera
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.serialization import build_value
from jaxunshear.errors import UserError
from jaxunshear.files import read_json


@dataclass(frozen=True)
class Preset:
    """What a calibration fits."""

    sensor: Sensor
    camera: Camera
    friction: float


def read_preset(file: Path) -> Preset:
    """Read the field `preset` of a calibration.json. Raises UserError."""
    remedy = "name a calibration.json of `jaxunshear calibrate`"
    if not file.is_file():
        raise UserError(f"--sensor-from {file} is no file: {remedy}")
    stored = read_json(file)
    if not isinstance(stored, dict) or "preset" not in stored:
        raise UserError(f"--sensor-from {file} holds no preset: {remedy}")
    return build_value(stored["preset"], Preset, f"--sensor-from {file}", "preset")


def apply_preset(experiment: Experiment, file: Path) -> Experiment:
    """Set the sensor, camera and friction that are in `file`; frames keep their number of pixels.

    Raises UserError.
    """
    paired = experiment.paired.get_simulated("--sensor-from")
    pose = cast(PoseData, experiment.pose)
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
