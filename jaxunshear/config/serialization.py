"""Settings as JSON, and back: of experiments, finished runs, released weights and calibrations.

>>> experiment = load_settings(find_model_folder(Path("standard")))
>>> experiment = apply_preset(experiment, Path("calibration/calibration.json"))
"""

import dataclasses
import typing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from jaxunshear.config.data import PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.sensor import Camera, Sensor
from jaxunshear.config.types import (
    Hint,
    describe_hint,
    get_origin,
    is_of_type,
    list_groups,
    list_hints,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_json, read_object
from jaxunshear.version import __version__

VERSION = "version"  # of the package that wrote the settings beside it
# older files do not name their version
OLD_FILES = "files of version 0.2.0 and earlier are not read"


def to_json(experiment: Experiment) -> Json:
    """Convert an experiment to nested dictionaries and lists."""
    return dataclasses.asdict(experiment)


def from_json(data: object, source: str = "experiment.json") -> Experiment:
    """Return the experiment that `to_json` wrote, with or without the version.

    Raises UserError naming fields that are unknown, missing or of a wrong type, or another version.
    """
    settings = remove_version(data, source) if isinstance(data, dict) else data
    return build_value(settings, Experiment, source, "")


def add_version(settings: Json) -> Json:
    """Add the version of the package, which reads only its own files, to `settings`."""
    return {VERSION: __version__} | settings


def remove_version(stored: Json, source: object) -> Json:
    """Return `stored` without its version. Raises UserError if this version does not read it."""
    version = stored.get(VERSION, __version__)
    if _get_minor(version) != _get_minor(__version__):
        raise UserError(
            f"{source} was written by jaxunshear {version}, and this is {__version__}: "
            "use that version, or make it again in another folder"
        )
    return {name: value for name, value in stored.items() if name != VERSION}


def _get_minor(version: object) -> list[str]:
    """Return major and minor version; versions that share them read each other's files."""
    return str(version).split(".")[:2]


def build_value(data: object, kind: Hint, source: str, name: str) -> Any:
    """Make a value of type `kind` from JSON. Raises UserError.

    Args:
        source: the file, for messages.
        name: where in `source` the value stands.
    """
    item_kind = typing.get_args(kind)[0] if get_origin(kind) is tuple else None
    if list_groups(item_kind) and isinstance(data, list):
        return tuple(
            item if isinstance(item, str) else build_value(item, item_kind, source, name)
            for item in data
        )
    if kinds := list_groups(kind):
        return _build_group(data, kinds, source, name)
    value = _convert_to_tuples(data)
    if not is_of_type(value, kind):
        raise UserError(f"{source}: {name} takes {describe_hint(kind)}, not {data!r}")
    return value


def _build_group(data: object, kinds: list[type], source: str, name: str) -> Any:
    """Make settings of that one of `kinds` which the fields in `data` fit best."""
    problem = f"{source} does not fit version {__version__}: "
    if not isinstance(data, dict):
        raise UserError(f"{problem}{name or 'its top level'} is no group; run it again")
    prefix = f"{name}." if name else ""
    kind = min(kinds, key=lambda each: len(_list_misfits(data, list_hints(each), prefix)))
    fields = list_hints(kind)
    if misfits := _list_misfits(data, fields, prefix):
        raise UserError(f"{problem}{', '.join(misfits)}; {OLD_FILES}: run it again")
    parts = {
        field: build_value(data[field], hint, source, f"{prefix}{field}")
        for field, hint in fields.items()
    }
    return kind(**parts)


def _list_misfits(data: Json, fields: dict[str, Hint], prefix: str) -> list[str]:
    """List what is in the data but no field, and the fields that the data lack."""
    unknown = sorted(data.keys() - fields.keys())
    missing = sorted(fields.keys() - data.keys())
    return [
        *(f"{prefix}{field} = {data[field]!r} is no setting" for field in unknown),
        *(f"{prefix}{field} is missing" for field in missing),
    ]


def _convert_to_tuples(data: object) -> object:
    return tuple(_convert_to_tuples(item) for item in data) if isinstance(data, list) else data


RELEASED = Path(__file__).parents[1] / "weights"  # a folder for each name, with a model card


def find_model_folder(model: Path) -> Path:
    """Return the folder of the released weights of this name; any other path as it is."""
    is_name = len(model.parts) == 1 and not model.exists()
    released = RELEASED / model
    return released if is_name and (released / "experiment.json").is_file() else model


def is_released(model: Path) -> bool:
    """Return whether a folder holds released weights, which keep no results."""
    return any(model.glob("*/weights.npz"))


def load_settings(model: Path) -> Experiment:
    """Load the experiment that a folder was made with. Raises UserError."""
    file = model / "experiment.json"
    if not file.is_file():
        names = ", ".join(sorted(folder.name for folder in RELEASED.glob("*") if folder.is_dir()))
        raise UserError(
            f"{model} holds no experiment.json: name the folder of a finished run, "
            f"such as runs/demo, or released weights{f' ({names})' if names else ''}"
        )
    return from_json(read_object(file), str(file))


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
