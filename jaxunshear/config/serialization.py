"""Settings as JSON, and back: of experiments, finished runs, released weights and calibrations.

>>> experiment = load_settings(find_model_folder(Path("standard")))
>>> experiment = apply_preset(experiment, Path("calibration/calibration.json"))
"""

import dataclasses
import typing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.sensor import Camera, Sensor
from jaxunshear.config.types import (
    Hint,
    describe_hint,
    get_origin,
    get_value,
    is_of_type,
    list_choices,
    list_groups,
    list_hints,
    replace_value,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_json, read_object
from jaxunshear.version import __version__

VERSION = "version"  # of the package that wrote the settings beside it
# older files do not name their version
OLD_FILES = "files of version 0.2.0 and earlier are not read"


def to_json(experiment: Experiment) -> Json:
    return dataclasses.asdict(experiment)


def from_json(data: object, source: str = "experiment.json") -> Experiment:
    """Return the experiment that `to_json` wrote. Raises UserError that names what does not fit."""
    settings = remove_version(data, source) if isinstance(data, dict) else data
    return build_value(settings, Experiment, source, "")


def add_version(settings: Json) -> Json:
    """Add the version of the package, which reads only its own files, to `settings`."""
    return {VERSION: __version__} | settings


def remove_version(stored: Json, source: object) -> Json:
    """Return `stored` without its version. Raises UserError if this version does not read it."""
    version = str(stored.get(VERSION, __version__))
    # versions that share major and minor number read each other's files
    if version.split(".")[:2] != __version__.split(".")[:2]:
        raise UserError(
            f"{source} was written by jaxunshear {version}, and this is {__version__}: "
            "use that version, or make it again in another folder"
        )
    return {name: value for name, value in stored.items() if name != VERSION}


def build_value(data: object, kind: Hint, source: str, name: str) -> Any:
    """Make a value of type `kind` from JSON at `name` in the file `source`. Raises UserError."""
    item_kind = typing.get_args(kind)[0] if get_origin(kind) is tuple else None
    if list_groups(item_kind) and isinstance(data, list):
        return tuple(build_value(item, item_kind, source, name) for item in data)
    kinds = list_groups(kind)
    if kinds and not (isinstance(data, str) and list_choices(kind)):
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
    kind = min(kinds, key=lambda each: len(data.keys() ^ list_hints(each).keys()))
    hints = list_hints(kind)
    unknown, missing = sorted(data.keys() - hints.keys()), sorted(hints.keys() - data.keys())
    misfits = [f"{prefix}{field} = {data[field]!r} is no setting" for field in unknown]
    misfits += [f"{prefix}{field} is missing" for field in missing]
    if misfits:
        raise UserError(f"{problem}{', '.join(misfits)}; {OLD_FILES}: run it again")
    values = {
        field: build_value(data[field], hint, source, f"{prefix}{field}")
        for field, hint in hints.items()
    }
    return kind(**values)


def _convert_to_tuples(data: object) -> object:
    return tuple(_convert_to_tuples(item) for item in data) if isinstance(data, list) else data


RELEASED = Path(__file__).parents[1] / "weights"  # a folder for each name, with a model card


def find_model_folder(model: Path) -> Path:
    """Return the folder of the released weights of this name; any other path as it is."""
    is_name = len(model.parts) == 1 and not model.exists()
    released = RELEASED / model
    return released if is_name and (released / "experiment.json").is_file() else model


def check_unreleased(folder: Path, remedy: str = "name a finished run, such as runs/demo") -> None:
    """Refuse released weights where a run is meant. Raises UserError."""
    if any(find_model_folder(folder).glob("*/weights.npz")):
        raise UserError(
            f"{folder}: released weights hold no contacts and no scores: {remedy}, "
            f"or score them by `jaxunshear evaluate {folder} --recordings DIR`"
        )


def check_finished_run(folder: Path) -> None:
    """Refuse what is not the folder of a finished run. Raises UserError."""
    check_unreleased(folder)
    if not (folder / "results.json").is_file():
        if (folder / "experiment.json").is_file():
            raise UserError(f"{folder} is not finished: run its command again, which goes on")
        raise UserError(
            f"{folder} holds no results.json: name the folder of a finished run, such as runs/demo"
        )


def load_task_settings(model: Path) -> Experiment:
    """Load the experiment of a folder that can be used as a model.

    Raises UserError as `load_settings`, and for a run about several tasks.
    """
    experiment = load_settings(model)
    if experiment.paired.has_parts:
        raise UserError(f"{model} is about several tasks: name the folder of one, {model}/TASK")
    return experiment


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
    if file.is_dir():
        raise UserError(f"--sensor-from {file} is a folder: {remedy}")
    if not file.is_file():
        raise UserError(f"--sensor-from {file} does not exist: {remedy}")
    if file.suffix == ".py":
        raise UserError(f"--sensor-from {file} is an experiment, which fits no sensor: {remedy}")
    stored = read_json(file)
    if not isinstance(stored, dict) or "preset" not in stored:
        raise UserError(f"--sensor-from {file} holds no preset: {remedy}")
    return build_value(stored["preset"], Preset, f"--sensor-from {file}", "preset")


def apply_preset(experiment: Experiment, file: Path) -> Experiment:
    """Set the sensor, camera and friction in `file`; frames keep their pixels. Raises UserError."""
    experiment.paired.require_simulation("--sensor-from")
    preset = read_preset(file)
    changed = replace(experiment, sensor=preset.sensor)
    for name in ("paired", "pose"):
        frame_px = get_value(experiment, f"{name}.camera.frame_px")
        camera = replace(preset.camera, frame_px=frame_px)
        changed = replace_value(changed, f"{name}.camera", camera)
        changed = replace_value(changed, f"{name}.friction", preset.friction)
    return changed
