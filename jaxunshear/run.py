"""Runs the stages of an experiment in their order: data, trainings, evaluation, report.

Every stage leaves its work under one folder and finds it again, so the same command continues a
stopped run. Only this file knows their order.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from jaxunshear.cluster import CallRunner, run_locally
from jaxunshear.config import configs
from jaxunshear.config.experiment import Experiment, get_recorded, get_training
from jaxunshear.config.registry import TEACHER, TRAINABLE
from jaxunshear.config.serialization import from_json, to_json, with_version
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object, write_json
from jaxunshear.locks import hold_lock
from jaxunshear.results.run import Results
from jaxunshear.results.times import TIMES, read_times
from jaxunshear.training.data_origin import check_origin, describe_origin
from jaxunshear.training.initial_weights import InitialWeights, data_of, start_folder

TEACHER_SEED = 1000  # beyond the run's own
LOCK = "run.lock"  # a row of a sweep has a lock of its own


def run_stages(
    experiment: Experiment,
    stages: tuple[str, ...],
    out: Path,
    data: Path,
    command: str,
    run_calls: CallRunner = run_locally,
) -> Results | None:
    """Run `stages` ("data", names of networks, "evaluate", "report") into out/<name>.

    `run_calls` runs the simulations. Returns the results if they were evaluated. Raises UserError
    for whatever a person can fix, and if another process is at work in that folder.
    """
    for network in TRAINABLE:
        if network in stages:
            start_folder(experiment, network)  # refused before data are made in vain
    folder = Path(out) / experiment.name
    with hold_lock(folder / LOCK, wait=False) as free:
        if not free:
            raise UserError(
                f"another run is at work in {folder}: wait for it, stop it, or give another --out"
            )
        _store_settings(experiment, folder)
        return _run(experiment, stages, folder, data, command, run_calls)


def _run(
    experiment: Experiment,
    stages: tuple[str, ...],
    folder: Path,
    data: Path,
    command: str,
    run_calls: CallRunner,
) -> Results | None:
    results = None
    for stage in stages:
        is_partial = partial(_is_partial, experiment, stage, folder, data)
        before = read_times(folder).get(stage, 0.0) if is_partial() else 0.0
        began, worked = time.perf_counter(), False
        try:
            if stage == "data":
                worked = _make_data(experiment, data, run_calls)
            elif stage in TRAINABLE:
                worked = _train(experiment, stage, folder, data)
            elif stage == "evaluate":
                from jaxunshear.evaluation.evaluate import evaluate

                results, worked = evaluate(experiment, folder, data, command), True
                print_summary(results, folder)
            else:
                from jaxunshear.report.report import write_report

                print(f"report: {write_report(folder)}")  # its time cannot stand in itself
        finally:
            if worked or is_partial():
                _store_time(folder, stage, before + time.perf_counter() - began)
    return results


def _store_settings(experiment: Experiment, folder: Path) -> None:
    """Write experiment.json; refuse to mix two different experiments in one folder."""
    path = folder / "experiment.json"
    settings = to_json(experiment)
    # a run that has not started has data at most, which lie elsewhere
    started = any(each.name not in (path.name, LOCK, TIMES) for each in folder.iterdir())
    if path.exists():
        try:
            stored = to_json(from_json(read_object(path), str(path)))
        except UserError as error:
            if started:
                raise UserError(
                    f"{error}; to start anew give another --out, or delete {folder}"
                ) from error
            stored = {}
        changed = [name for name in configs.list_differences(stored, settings) if name != "claim"]
        if changed and started:
            raise UserError(
                f"{folder} holds a run with another {', '.join(changed[:3])}: "
                "give another --out, or delete that folder"
            )
        if changed:
            (folder / TIMES).unlink(missing_ok=True)  # it is of other data
    write_json(path, with_version(settings))


def _make_data(experiment: Experiment, data: Path, run_calls: CallRunner) -> bool:
    """Make the data sets, or find them. Return whether there was anything to do."""
    from jaxunshear.data.chunks import make_engine
    from jaxunshear.data.generation import make_sets

    complete = all(_exist(experiment, data, configs.get_set_folder))
    for name, metadata in make_sets(experiment, data, make_engine(run_calls)).items():
        counts = metadata["counts"]
        text = f"{name}: {counts['written']} examples, {counts['dropped']} contacts dropped"
        print(text + _describe_slowest(counts))
    return not complete


def _describe_slowest(counts: Json) -> str:
    """Name the slowest simulated contact; recordings have none."""
    if "iterations" not in counts:
        return ""
    iterations = counts["iterations"]
    return (
        f"; slowest contact {iterations['slowest_number']}: {iterations['most']} iterations, "
        f"the median one {iterations['median']:.0f}"
    )


def _exist(experiment: Experiment, data: Path, get_folder: Callable[..., Path]) -> list[bool]:
    """Return for each data set whether its folder exists."""
    from jaxunshear.data.generation import list_sets

    return [
        get_folder(settings, experiment.sensor, data).exists()
        for settings in list_sets(experiment).values()
    ]


def _train(experiment: Experiment, network: str, folder: Path, data: Path) -> bool:
    """Train one network, or find it trained. Returns whether there was anything to do."""
    from jaxunshear.training.checkpoint import SUMMARY, compute_weights_digest, has_model, load_best

    if (folder / network / SUMMARY).exists():
        if not has_model(folder / network):
            raise UserError(
                f"{folder / network} has lost its checkpoints: delete that folder, "
                "then run the same command"
            )
        check_origin(experiment, network, folder)
        return False
    from jaxunshear.training.examples import FRAME, open_examples, open_recorded_set
    from jaxunshear.training.few_pairs import (
        add_same_pose_slides,
        add_taps,
        open_taps,
        select_few_pairs,
    )
    from jaxunshear.training.task_factory import make_task, rename_inputs, take_first
    from jaxunshear.training.trainer import train

    seed = experiment.seed + (TEACHER_SEED if network == TEACHER else 0)
    training, examples = (
        get_training(experiment, network),
        open_examples(experiment, network, data, folder),
    )
    if get_recorded(experiment):
        write_json(folder / FRAME, open_recorded_set(experiment, data).frame)
    full = examples
    if training.paired_share < 1:
        examples = select_few_pairs(full, training.paired_share, experiment.seed)
    task, fields = make_task(experiment, network, examples, folder)
    batches = examples.reader.train_batches(training.batch, seed, training.shift, fields)
    beside = max(1, training.batch // 2)
    if "tap" in training.losses:
        batches = add_taps(batches, open_taps(experiment, data), beside, seed)
    if "consistency" in training.losses:
        batches = add_same_pose_slides(batches, full, beside, seed)
    begin = start_folder(experiment, network)
    summary = train(
        task,
        training,
        lambda start: map(rename_inputs, batches(start)),
        take_first(examples.reader.split, training.validation_images, fields),
        seed,
        folder / network,
        epoch_images=examples.epoch,
        origin=describe_origin(experiment, network),
        data=data_of(experiment, network, begin),
        start=InitialWeights(load_best(begin), compute_weights_digest(begin)) if begin else None,
    )
    loss = "unknown" if summary.best_loss is None else f"{summary.best_loss:.5f}"
    print(
        f"{network}: {summary.images} images in {summary.train_seconds:.0f} s "
        f"({summary.images_per_second:.0f} a second), "
        f"best validation loss {loss} at step {summary.best_step} of {summary.steps}"
    )
    return True


def _is_partial(experiment: Experiment, stage: str, folder: Path, data: Path) -> bool:
    """Return whether a stopped run has left work of `stage` that can be continued.

    An evaluation always begins from the start.
    """
    if stage == "data":
        complete = _exist(experiment, data, configs.get_set_folder)
        partial_sets = _exist(experiment, data, configs.get_unfinished_folder)
        return not all(complete) and any((*complete, *partial_sets))
    place = folder / stage
    started = (place / "model.json").exists()
    return stage in TRAINABLE and started and not (place / "summary.json").exists()


def _store_time(folder: Path, stage: str, seconds: float) -> None:
    """Store the seconds that a stage took; those of a killed process are lost."""
    write_json(folder / TIMES, read_times(folder) | {stage: round(seconds, 3)})


def print_summary(results: Results, folder: Path) -> None:
    """Print the main figures of an evaluation, and where the rest is."""
    if not results.simulated:
        _print_recordings_summary(results, folder)
        return
    from jaxunshear.evaluation.measurements import build_measurements
    from jaxunshear.evaluation.score import BASELINES
    from jaxunshear.report import labels
    from jaxunshear.text_table import format_text_table

    likeness, errors, name = results.ms_ssim, results.pose_mae, str(results.metric["ms_ssim"])
    rows = [
        {
            "": labels.name_kind(results, kind),
            name: likeness.get(kind, {}).get("overall"),
            **errors.get(kind, {}),
        }
        for kind in labels.KINDS
        if kind in (*likeness, *errors) and kind not in BASELINES
    ]
    print(format_text_table(rows, ("", name, *labels.list_targets(results))))
    for row in build_measurements(replace(results, tests={})).rows:
        if row.bar is not None:
            met = "met" if row.ok else "MISSED"
            print(f"{row.name} {row.value} {row.unit} (bar {row.sense} {row.bar}: {met})")
    print(f"results: {folder / 'results.json'}")


def _print_recordings_summary(results: Results, folder: Path) -> None:
    """Print a table of all targets, which recordings may have any of."""
    from jaxunshear.evaluation.other_recordings import format_table
    from jaxunshear.evaluation.score import choose_main_kind

    print(format_table(results))
    if likeness := results.ms_ssim:
        sheared = likeness["sheared"]["overall"]
        unsheared = likeness[choose_main_kind(likeness)]["overall"]
        metric = results.metric["ms_ssim"]
        print(f"{metric} with the partner: {sheared:.3f} as felt, {unsheared:.3f} unsheared")
    print(f"results: {folder / 'results.json'}")
