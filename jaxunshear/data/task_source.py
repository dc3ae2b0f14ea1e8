"""Recordings of several tasks as one data source: one network learns to unshear all of them.

>>> source = open_source(experiment)  # its `paired` is `RecordedTasks`
>>> source.list_parts()  # the experiment of each task alone

Pins of all tasks are given in the frame of the first. A frame may differ from it by a shift, which
the mean over the pins at the rim shows: a contact moves these little, and towards all sides.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from jaxunshear.config.data import Recorded, RecordedTasks
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.network_config import NetworkConfig
from jaxunshear.config.networks import POSENET, POSENET_SHEARED, select_networks
from jaxunshear.config.targets import (
    Target,
    Targets,
    count_outputs,
    list_target_names,
    make_move_targets,
    name_pose_field,
)
from jaxunshear.data.chunks import join_field
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.data.recorded_source import RecordedSource, read_pin_layout
from jaxunshear.data.slide_transfer import (
    SlideTransfer,
    TransferReader,
    give_slides,
    make_slide_transfer,
)
from jaxunshear.data.sources import DataSource, Examples, Helpers, PinLayout
from jaxunshear.files import Json
from jaxunshear.perception.lattice import find_rim

LATERAL = {"x_mm", "y_mm"}  # where an object is under the sensor
PIN_FIELDS = ("canonical_pins", "sheared_pins")


class FrameShift(NamedTuple):
    """What brings px of one frame to those of another."""

    shift: np.ndarray  # (2,) px
    left_px: float  # rms distance of all rest positions that is left over


def align_frames(frame: Json, reference: Json) -> FrameShift:
    """Align the pins' rest positions of a frame with those of a reference, by their rim."""
    difference = np.array(reference["place_px"]) - np.array(frame["place_px"])
    shift = difference[find_rim(np.array(reference["shell"]))].mean(axis=0)
    left = np.square(difference - shift).sum(axis=1)
    return FrameShift(shift, float(np.sqrt(left.mean())))


class TaskSource(DataSource):
    """Recordings of several tasks, days or sensors of one make: `RecordedTasks`."""

    pair_fields = (*RecordedSource.pair_fields, "stimulus")
    pin_fields = RecordedSource.pin_fields
    has_frame = True
    runner = "jaxunshear.task_run:run_tasks"

    def describe(self) -> str:
        names = ", ".join(self.settings.names)
        return f"This network learnt from recordings of several tasks ({names})."

    def list_parts(self) -> list[Experiment]:
        """List the experiment of each task alone, by the names of the tasks."""
        settings: RecordedTasks = self.settings
        parts = []
        for part, task in zip(settings.names, settings.tasks, strict=True):
            names = (*self.experiment.networks, POSENET, POSENET_SHEARED)
            networks = select_networks(names, taps=True, slides=bool(task.slide_folder))
            parts.append(replace(self.experiment, name=part, paired=task, networks=networks))
        return parts

    def list_taught_parts(self) -> list[Experiment]:
        """List the experiments of the tasks that the joint network learns.

        These are all over pins. Over images a task without slides is left out.
        """
        return self.list_parts() if uses_pins(self.experiment) else self.list_parts_with_slides()

    def list_parts_with_slides(self) -> list[Experiment]:
        return [part for part in self.list_parts() if cast(Recorded, part.paired).slide_folder]

    def list_test_digests(self) -> set[str]:
        return set().union(*(source.list_test_digests() for source in self._list_sources()))

    def list_digests(self, settings: object) -> set[str]:
        return self.list_test_digests()

    def _list_sources(self) -> list[RecordedSource]:
        return [RecordedSource(part) for part in self.list_parts()]

    def describe_origin(self, config: NetworkConfig) -> Json:
        origins = []
        for source, task in zip(
            self._list_sources(), cast(RecordedTasks, config.source).tasks, strict=True
        ):
            origin = source.describe_origin(replace(config, source=task))
            origins.append(origin if task.slide_folder else origin | {"pairing": "transferred"})
        return {"tasks": origins}

    def open_examples(self, config: NetworkConfig, data_dir: Path, helpers: Helpers) -> Examples:
        """Open the pairs of all tasks, in one frame."""
        tasks = [_open_task(part, data_dir, helpers) for part in self.list_taught_parts()]
        frames = [task.stored.frame for task in tasks]
        shifts = [align_frames(frame, frames[0]) for frame in frames]
        readers, transfers = _open_readers(tasks, config.modality == "images")
        reader = join_readers(readers, shifts, tasks[0].stored.size, transfers)
        load_teachers = [
            partial(task.helpers.load_teacher, shift.shift)
            for task, shift in zip(tasks, shifts, strict=True)
        ]
        return Examples(
            reader,
            join_targets([task.targets for task in tasks]),
            average_layouts(frames, shifts),
            reader.length("train"),
            slide_targets=make_move_targets(reader.rows("train")["move"]),
            load_teachers=tuple(load_teachers),
            tasks=len(tasks),
        )


class _OpenTask(NamedTuple):
    part: Experiment
    stored: RecordedSet
    targets: Targets
    helpers: Helpers


def _open_task(part: Experiment, data_dir: Path, helpers: Helpers) -> _OpenTask:
    stored = RecordedSource(part).open_stored(data_dir)
    return _OpenTask(part, stored, stored.make_targets(part.targets), helpers.select_part(part))


def _open_readers(
    tasks: Sequence[_OpenTask], images: bool
) -> tuple[list[Reader], dict[int, SlideTransfer]]:
    """Open the pairs of each task; also return how tasks without slides get some, by their number.

    Over images each task has slides.
    """
    recorded = {
        task.part.name: RecordedSource(task.part).open_pairs(
            task.stored, task.targets, task.helpers, images
        )
        for task in tasks
        if cast(Recorded, task.part.paired).slide_folder
    }
    others = tuple(recorded.values())
    readers, transfers = [], {}
    for number, task in enumerate(tasks):
        if task.part.name in recorded:
            readers.append(recorded[task.part.name])
        else:
            rest = read_pin_layout(task.stored.frame).rest
            is_placed = not LATERAL.isdisjoint(list_target_names(task.targets))
            transfer = transfers[number] = make_slide_transfer(others, rest, is_placed)
            give = partial(give_slides, task.stored, transfer)
            readers.append(task.stored.read_pairs(task.targets, images=False, simulate=give))
    return readers, transfers


def join_readers(
    readers: Sequence[Reader],
    shifts: Sequence[FrameShift],
    size: int,
    transfers: Mapping[int, SlideTransfer],
) -> Reader:
    """Join readers of pairs: `stimulus` is the task, and pins are in the frame of the first."""

    def load(split: str) -> Batch:
        parts = []
        for task, (reader, shift) in enumerate(zip(readers, shifts, strict=True)):
            rows = dict(reader.rows(split))
            for field in PIN_FIELDS:
                rows[field] = (rows[field] + shift.shift).astype(np.float32)
            rows["stimulus"] = np.full(len(rows["pose"]), task, np.int32)
            unknown = np.full_like(rows["pose"], np.nan)
            for other in range(len(readers)):
                rows[name_pose_field(other)] = rows["pose"] if other == task else unknown
            parts.append(rows)
        fields = set.intersection(*map(set, parts)) - {"others"}
        return {field: join_field(parts, field) for field in fields}

    return TransferReader(load, size, transfers)


def join_targets(targets: Sequence[Targets]) -> Targets:
    """Join the targets of all tasks; those of a task weigh as much as if they were alone."""
    joined: list[Target] = []
    counts = list(map(count_outputs, targets))
    for task, own in enumerate(targets):
        share, field = sum(counts) / counts[task], name_pose_field(task)
        joined += [replace(each, field=field, weight=share * each.weight) for each in own]
    return tuple(joined)


def average_layouts(frames: Sequence[Json], shifts: Sequence[FrameShift]) -> PinLayout:
    """Average the rest positions of all tasks in the frame of the first."""
    layouts = [read_pin_layout(frame) for frame in frames]
    aligned = [each.rest + shift.shift for each, shift in zip(layouts, shifts, strict=True)]
    return layouts[0]._replace(rest=np.stack(aligned).mean(axis=0).astype(np.float32))
