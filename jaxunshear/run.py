"""The stages of an experiment, in the order of the data: data, trainings, evaluation, report.

Every stage leaves its work under one folder and finds it again, so the same command continues a stopped run. Only this file
knows their order.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxunshear.config import from_json, to_json
from jaxunshear.dataset import configs
from jaxunshear.errors import UserError
from jaxunshear.experiment import (
    POSENETS,
    RENDERER,
    TEACHER,
    TRAINABLE,
    Experiment,
    over_pins,
    recorded_of,
    training_of,
)
from jaxunshear.infer import model_folder
from jaxunshear.locks import locked
from jaxunshear.model.settings import PinPoseNet, PinRenderer, PinUnshear, UNet, UnshearNet, without_codes
from jaxunshear.storage import read_json, read_json_if_sound, write_json
from jaxunshear.targets import fields_of
from jaxunshear.training.origin import check_origin, origin_of
from jaxunshear.training.settings import labelled

if TYPE_CHECKING:
    from jaxunshear.training.examples import Examples
    from jaxunshear.training.tasks import Task

TEACHER_SEED = 1000  # beyond the run's own
TIMES = "times.json"
LOCK = "run.lock"  # a row of a sweep has a lock of its own


def run_stages(experiment: Experiment, stages: tuple[str, ...], out: Path, data: Path, command: str) -> dict[str, Any]:
    """Run `stages` ("data", names of networks, "evaluate", "report") into out/<name>.

    Returns the results where they were evaluated, else nothing. Raises UserError for whatever a person can mend, and
    where another process is at work in that folder.
    """
    for network in TRAINABLE:
        if network in stages:
            start_folder(training_of(experiment, network).start, network)  # before data are made in vain
    folder = Path(out) / experiment.name
    with locked(folder / LOCK, wait=False) as free:
        if not free:
            raise UserError(f"another run is at work in {folder}: wait for it, stop it, or give another --out")
        _keep_settings(experiment, folder)
        return _run(experiment, stages, folder, data, command)


def _run(experiment: Experiment, stages: tuple[str, ...], folder: Path, data: Path, command: str) -> dict[str, Any]:
    results: dict[str, Any] = {}
    for stage in stages:
        halfway = partial(_halfway, experiment, stage, folder, data)
        before = _times(folder).get(stage, 0.0) if halfway() else 0.0
        began, worked = time.perf_counter(), False
        try:
            if stage == "data":
                worked = _make_data(experiment, data)
            elif stage in TRAINABLE:
                worked = _train(experiment, stage, folder, data)
            elif stage == "evaluate":
                from jaxunshear.evaluation.evaluate import evaluate

                results, worked = evaluate(experiment, folder, data, command), True
                _tell(results)
            else:
                from jaxunshear.report.report import write_report

                print(f"report: {write_report(folder)}")  # its time cannot stand in itself
        finally:
            if worked or halfway():
                _keep_time(folder, stage, before + time.perf_counter() - began)
    return results


def _keep_settings(experiment: Experiment, folder: Path) -> None:
    """experiment.json, or a refusal to mix the work of two different experiments in one folder."""
    path = folder / "experiment.json"
    wanted = to_json(experiment)
    begun = any(
        each.name not in (path.name, LOCK, TIMES) for each in folder.iterdir()
    )  # else data at most, which lie elsewhere
    if path.exists():
        try:
            stored = to_json(from_json(read_json(path), str(path)))
        except UserError as error:
            if begun:
                raise UserError(f"{error}; to start anew give another --out, or delete {folder}") from error
            stored = {}
        changed = [name for name in configs.differences(stored, wanted) if name != "claim"]
        if changed and begun:
            raise UserError(
                f"{folder} holds a run with another {', '.join(changed[:3])}: give another --out, or delete that folder"
            )
        if changed:
            (folder / TIMES).unlink(missing_ok=True)  # of the making of other data
    write_json(path, wanted)


def _make_data(experiment: Experiment, data: Path) -> bool:
    from jaxunshear.dataset.making import make_sets

    there = all(_exist(experiment, data, configs.set_folder))
    for name, metadata in make_sets(experiment, data).items():
        counts = metadata["counts"]
        print(f"{name}: {counts['written']} examples, {counts['dropped']} contacts dropped")
    return not there


def _exist(experiment: Experiment, data: Path, folder_of: Callable[..., Path]) -> list[bool]:
    """Of each data set, whether its `folder_of` is there."""
    from jaxunshear.dataset.making import sets_of

    return [folder_of(settings, experiment.sensor, data).exists() for settings in sets_of(experiment).values()]


def _train(experiment: Experiment, network: str, folder: Path, data: Path) -> bool:
    """Train one network, or find it trained. Returns whether there was anything to do."""
    from jaxunshear.training.checkpoint import SUMMARY, digest_of, holds_model, load_best

    if (folder / network / SUMMARY).exists():
        if not holds_model(folder / network):
            raise UserError(
                f"{folder / network} has lost its checkpoints: delete that folder, then run the same command"
            )
        check_origin(experiment, network, folder)
        return False
    from jaxunshear.training.examples import FRAME, open_examples, stored_of
    from jaxunshear.training.loop import train
    from jaxunshear.training.start import Start

    seed = experiment.seed + (TEACHER_SEED if network == TEACHER else 0)
    training, examples = training_of(experiment, network), open_examples(experiment, network, data, folder)
    if recorded_of(experiment):
        write_json(folder / FRAME, stored_of(experiment, data).frame)
    task, fields = _task(experiment, network, examples, folder)
    batches = examples.reader.train_batches(training.batch, seed, training.shift, fields, training.mirror)
    begin = start_folder(training.start, network)
    summary = train(
        task,
        training,
        lambda start: map(_renamed, batches(start)),
        _first(examples.reader.split, training.validation_images, fields),
        seed,
        folder / network,
        epoch_images=examples.reader.length("train"),
        origin=origin_of(experiment, network),
        start=Start(load_best(begin), digest_of(begin)) if begin else None,
    )
    print(
        f"{network}: {summary.images} images in {summary.train_seconds:.0f} s ({summary.images_per_second:.0f} a second), "
        f"best validation loss {summary.best_loss:.5f} at step {summary.best_step} of {summary.steps}"
    )
    return True


def start_folder(model: str, network: str) -> Path | None:
    """Where `network` of the weights to go on from lies, if any are asked for. Raises UserError where it is not there."""
    if not model:
        return None
    folder = model_folder(Path(model))
    if not (folder / network / "model.json").is_file():
        raise UserError(
            f"start: {folder} holds no {network}: name a run that trained it, or released weights that have it"
        )
    return folder / network


def _teacher(experiment: Experiment, folder: Path) -> Callable[[Any], Any]:
    from jaxunshear.model import posenet
    from jaxunshear.training.checkpoint import load_best, read_net

    path = folder / TEACHER
    if not (path / "summary.json").exists():
        raise UserError(f"{path} is missing, and train.pose_weight needs it: train {TEACHER} first")
    check_origin(experiment, TEACHER, folder)
    net: Any = read_net(path)
    return partial(posenet.predict, net, load_best(path))


def unshear_net(net: UnshearNet, network: str) -> UnshearNet | UNet:
    """The settings of one of the networks that unshear, all derived from `net`."""
    from jaxunshear.model.unshearnet import as_large_entangled

    if network == "unet":
        return UNet(net.size, net.widths, net.residual, net.both_sides)
    if network == "entangled_large":
        return as_large_entangled(dataclasses.replace(net, disentangled=True))
    if network == "entangled":
        return dataclasses.replace(without_codes(net), disentangled=False)
    return dataclasses.replace(net, disentangled=True)


def _task(experiment: Experiment, network: str, examples: "Examples", folder: Path) -> tuple["Task", tuple[str, ...]]:
    """What `network` learns, and the fields of a batch that this takes."""
    from jaxunshear.training import pin_tasks, tasks
    from jaxunshear.training.examples import spread_of

    training, targets, labels = training_of(experiment, network), examples.targets, fields_of(examples.targets)
    weighed = ("weight",) if recorded_of(experiment) and network not in POSENETS and network != RENDERER else ()
    if network == RENDERER or over_pins(experiment):
        field = {"posenet": "pins", RENDERER: "pins"}.get(network, "sheared_pins")
        known = (targets, examples.pins.rest, spread_of(examples.reader, field, examples.pins.rest))
        net = asdict(experiment.pins)
        if network == RENDERER:
            return pin_tasks.renderer_task(PinRenderer(**net), training, *known), ("pins", *labels)
        if network in POSENETS:
            return pin_tasks.pin_posenet_task(PinPoseNet(**net), training, *known), (field, *labels)
        codes = PinUnshear(**net if network == "disentangled" else net | {"shear_code": 0})
        return pin_tasks.pin_unshear_task(codes, training, *known), ("canonical_pins", "sheared_pins", *weighed)
    if network in POSENETS:
        seen = "sheared" if network == "posenet_sheared" else "image"
        return tasks.posenet_task(experiment.posenet, training, targets), (seen, *labels)
    teacher = _teacher(experiment, folder) if training.pose_weight else None
    task = tasks.unshear_task(unshear_net(experiment.unshear, network), training, teacher, targets)
    return task, ("canonical", "sheared", *weighed, *(labels if labelled(training) else ()))


def _renamed(batch: dict[str, Any]) -> dict[str, Any]:
    """Trainings that read poses name whatever they look at "image", or "pins"."""
    if "canonical" in batch or "canonical_pins" in batch:
        return batch
    return {{"sheared": "image", "sheared_pins": "pins"}.get(name, name): x for name, x in batch.items()}


def _first(split: Callable[..., Iterator[Any]], count: int, fields: tuple[str, ...]) -> Callable[[], Iterator[Any]]:
    """The first `count` validation examples, in batches."""
    batch = 64

    def batches() -> Iterator[Any]:
        taken = 0
        for examples in split("validation", batch, fields):
            examples = {name: values[: count - taken] for name, values in examples.items()}
            taken += len(examples[fields[0]])
            yield _renamed(examples)
            if taken >= count:
                return

    return batches


def _halfway(experiment: Experiment, stage: str, folder: Path, data: Path) -> bool:
    """Whether a stopped run has left work of `stage` to go on with. An evaluation is always done from the start."""
    if stage == "data":
        there = _exist(experiment, data, configs.set_folder)
        return not all(there) and any((*there, *_exist(experiment, data, configs.unfinished_folder)))
    place = folder / stage
    return stage in TRAINABLE and (place / "model.json").exists() and not (place / "summary.json").exists()


def _times(folder: Path) -> dict[str, float]:
    """times.json: wall-clock seconds of each stage, summed over the runs that it was stopped and continued in.

    A stage that is done again from the start counts anew. What a run had spent that was killed outright is lost.
    """
    return read_json_if_sound(folder / TIMES) or {}  # times are no reason to lose the work that they tell of


def _keep_time(folder: Path, stage: str, seconds: float) -> None:
    write_json(folder / TIMES, _times(folder) | {stage: round(seconds, 3)})


def _tell(results: dict[str, Any]) -> None:
    from jaxunshear.evaluation.measurements import measurements

    for row in measurements(results | {"tests": {}})["rows"]:  # those of further tests fill pages: see the report
        bar = (
            ""
            if row["bar"] is None
            else f"  (bar {row.get('sense', '')} {row['bar']}: {'met' if row['ok'] else 'MISSED'})"
        )
        print(f"{row['name']:<40} {row['value']} {row['unit']}{bar}")
