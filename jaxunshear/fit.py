"""Experiments about recordings: the networks that these allow, and their sensor.

>>> experiment = set_recordings(BASE_EXPERIMENT, taps="recordings/tap", slides="recordings/slide")
"""

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

from jaxunshear.config.data import Recorded, RecordedTaps, RecordedTasks
from jaxunshear.config.experiment import PIN_TRAINING, Experiment
from jaxunshear.config.networks import (
    DISENTANGLED,
    POSENET,
    POSENET_SHEARED,
    REGISTRY,
    PinNet,
    UnshearNet,
    select_networks,
)
from jaxunshear.config.sensor import MarkerSensor
from jaxunshear.config.targets import LABELLED_SLIDES, RECORDED_FIELDS, list_column_names
from jaxunshear.config.training import POSENET_TRAINING, Training
from jaxunshear.config.types import Value
from jaxunshear.data.recorded_contacts import compute_digest, read_contacts
from jaxunshear.data.sensor_frame import identify_sensor
from jaxunshear.errors import Note, UserError
from jaxunshear.files import write_text

SHOWN_NOTES = 10  # on recordings
BASE_EXPERIMENT = Experiment(
    name="recorded",
    claim=(
        "A network that learnt from a sensor's own taps and slides "
        "takes the slide out of its images."
    ),
    networks=(DISENTANGLED, POSENET, POSENET_SHEARED),
    paired=Recorded(),
    pose=RecordedTaps(),
    unshear=UnshearNet(widths=(16, 32, 64, 128, 256), pose_channels=256, shear_channels=256),
    pins=PinNet(conv_channels=(24, 48, 96)),
    train=Training(
        epochs=6,
        batch=8,
        optimiser="muon",
        learning_rate=6e-3,
        shift=0.0,
        losses={"supervised": 1.0, "patch": 0.1, "reconstruction": 0.3},
        validate_every=250,
        validation_images=512,
    ),
    train_posenet=replace(
        POSENET_TRAINING,
        epochs=7,
        batch=16,
        optimiser="muon",
        learning_rate=1.5e-3,
        shift=0.0,
        validate_every=250,
        validation_images=512,
    ),
    # chosen on validation contacts of an edge, and of an edge and a surface together
    train_pins=replace(
        PIN_TRAINING,
        epochs=25,
        min_steps=500,
        rotated_below=1500,
        optimiser="muon",
        learning_rate=1e-2,
        losses={**PIN_TRAINING.losses, "pose_label": 0.1},
        validate_every=250,
    ),
)


def set_recordings(
    experiment: Experiment, taps: str = "", slides: str = "", pairs: str = ""
) -> Experiment:
    """Change `experiment` to the taps and slides in these folders, which may be one.

    Networks that they do not allow are left out: without taps nothing unshears, and poses are
    predicted by a PoseNet of slides alone. A sensor of a layout file is kept, others are identified
    by the number of pins. Raises UserError.
    """
    recorded = experiment.paired
    if not isinstance(recorded, Recorded):
        raise UserError(
            f"'{experiment.name}' is about simulated touches: "
            "recordings are for experiments such as experiments/recorded.py"
        )
    digest = compute_digest(tuple(folder for folder in (taps, slides) if folder), pairs)
    recorded = replace(recorded, tap_folder=taps, slide_folder=slides, digest=digest, pairs=pairs)
    if pairs:
        recorded = replace(recorded, pairing="file")
    contacts = read_contacts(recorded)
    for name in list_column_names(experiment.targets):
        if name not in contacts.others:
            known = ", ".join((*RECORDED_FIELDS, *LABELLED_SLIDES, *contacts.others))
            raise UserError(f"target '{name}' is unknown: use {known}")
    more = len(contacts.notes) - SHOWN_NOTES
    for note in (*contacts.notes[:SHOWN_NOTES], *([f"and {more} more"] if more > 0 else [])):
        warnings.warn(note, Note, stacklevel=2)
    has_slides = bool(contacts.is_slide.any()) or recorded.pairing == "simulated"
    has_taps = bool((~contacts.is_slide).any())
    if recorded.direct_taps != "none" and not has_taps:
        raise UserError(
            f"--paired.direct_taps {recorded.direct_taps}: "
            "these recordings hold no taps: leave it at none"
        )
    networks = select_networks(experiment.networks, has_taps, has_slides)
    if not networks:
        raise UserError(
            f"networks: none of {', '.join(experiment.networks)} can learn from these recordings"
        )
    if not isinstance(sensor := experiment.sensor, MarkerSensor):
        sensor = identify_sensor(contacts, recorded.preprocess)
    return replace(experiment, paired=recorded, networks=networks, sensor=sensor)


def set_tasks(experiment: Experiment, folders: Sequence[str]) -> Experiment:
    """Change `experiment` to recordings of several tasks, a folder each, for one network.

    Raises UserError if they are of different sensors, or no folder holds slides.
    """
    parts = [set_recordings(experiment, folder, folder) for folder in folders]
    digests = [cast(Recorded, part.paired).digest for part in parts]
    for number, (folder, part) in enumerate(zip(folders, parts, strict=True)):
        if (first := digests.index(digests[number])) < number:
            raise UserError(f"{folder} holds the recordings of {folders[first]}: name each once")
        if part.sensor != parts[0].sensor:
            raise UserError(
                f"{folder} is of a sensor of {part.sensor.pins} pins and {folders[0]} of one of "
                f"{parts[0].sensor.pins}: name recordings of sensors of one make"
            )
    tasks = tuple(
        replace(
            cast(Recorded, part.paired),
            tap_folder=folder if set(part.networks) - {POSENET_SHEARED} else "",
            slide_folder=folder if set(part.networks) - {POSENET} else "",
        )
        for folder, part in zip(folders, parts, strict=True)
    )
    networks = tuple(name for name in experiment.networks if REGISTRY[name].role == "unshears")
    if not any(task.tap_folder and task.slide_folder for task in tasks):
        raise UserError("none of the folders holds both taps and slides: nothing unshears")
    paired = RecordedTasks(tasks)
    return replace(experiment, paired=paired, networks=networks, sensor=parts[0].sensor)


def format_experiment(experiment: Experiment) -> str:
    """Format the source of an experiment file, with every field that is not at its default."""
    modules: dict[str, set[str]] = {}
    body = _format_dataclass(experiment, modules, 0)
    imports = "\n".join(
        f"from {module} import {', '.join(sorted(names))}"
        for module, names in sorted(modules.items())
    )
    docstring = f'"""{experiment.claim}\n\n    jaxunshear run {{this file}}\n"""'
    return f"{docstring}\n\n{imports}\n\nexperiment = {body}\n"


def _format_dataclass(settings: Value, modules: dict[str, set[str]], depth: int) -> str:
    kind = type(settings).__name__
    modules.setdefault(type(settings).__module__, set()).add(kind)
    indent = "    " * depth
    lines = []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        default = field.default_factory() if callable(field.default_factory) else field.default
        if value != default:
            lines.append(f"{indent}    {field.name}={_format_value(value, modules, depth + 1)},\n")
    return f"{kind}(\n{''.join(lines)}{indent})" if lines else f"{kind}()"


def _format_value(value: object, modules: dict[str, set[str]], depth: int) -> str:
    if dataclasses.is_dataclass(value):
        return _format_dataclass(cast(Value, value), modules, depth)
    if isinstance(value, tuple) and any(map(dataclasses.is_dataclass, value)):
        items = [_format_value(item, modules, depth + 1) for item in value]
        indent = "    " * (depth + 1)
        return "(\n" + "".join(f"{indent}{item},\n" for item in items) + "    " * depth + ")"
    return repr(value)


def write_experiment(experiment: Experiment, file: Path) -> None:
    """Write the experiment to a file to run again, and to change.

    Raises UserError if the file holds another experiment.
    """
    source = format_experiment(experiment)
    if file.exists() and file.read_text() != source:
        raise UserError(
            f"{file} is there, and is not what these options ask for: "
            f"`jaxunshear run {file}` runs it; else give another --name"
        )
    write_text(file, source)
