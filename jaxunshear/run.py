"""The stages of an experiment, in the order of the data: data, trainings, evaluation, report.

Every stage leaves its work under one folder and finds it again, so the same command continues a stopped run. Only this file
knows their order.
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
from jaxunshear.training.initial_weights import InitialWeights, list_training_digests, start_folder

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
    """Run `stages` ("data", names of networks, "evaluate", "report") into out/<name>. `run_calls`: who simulates.

    Returns the results where they were evaluated, else nothing. Raises UserError for whatever a person can fix, and
    where another process is at work in that folder.
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
        _keep_settings(experiment, folder)
        return _run(experiment, stages, folder, data, command, run_calls)


def _run(
    experiment: Experiment,
    stages: tuple[str, ...],
    folder: Path,
    data: Path,
    command: str,
    spread: CallRunner,
) -> Results | None:
    results = None
    for stage in stages:
        halfway = partial(_halfway, experiment, stage, folder, data)
        before = read_times(folder).get(stage, 0.0) if halfway() else 0.0
        began, worked = time.perf_counter(), False
        try:
            if stage == "data":
                worked = _make_data(experiment, data, spread)
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
            if worked or halfway():
                _keep_time(folder, stage, before + time.perf_counter() - began)
    return results


def _keep_settings(experiment: Experiment, folder: Path) -> None:
    """experiment.json, or a refusal to mix the work of two different experiments in one folder."""
    path = folder / "experiment.json"
    wanted = to_json(experiment)
    # before that there are data at most, which lie elsewhere
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
        changed = [name for name in configs.list_differences(stored, wanted) if name != "claim"]
        if changed and started:
            raise UserError(
                f"{folder} holds a run with another {', '.join(changed[:3])}: give another --out, or delete that folder"
            )
        if changed:
            (folder / TIMES).unlink(missing_ok=True)  # of the making of other data
    write_json(path, with_version(wanted))


def _make_data(experiment: Experiment, data: Path, spread: CallRunner) -> bool:
    from jaxunshear.data.chunks import make_engine
    from jaxunshear.data.generation import make_sets

    there = all(_exist(experiment, data, configs.get_set_folder))
    for name, metadata in make_sets(experiment, data, make_engine(spread)).items():
        counts = metadata["counts"]
        print(
            f"{name}: {counts['written']} examples, {counts['dropped']} contacts dropped{_slowest(counts)}"
        )
    return not there


def _slowest(counts: Json) -> str:
    """Nothing of sets made before this was counted, or from recordings."""
    if "iterations" not in counts:
        return ""
    spent = counts["iterations"]
    return f"; slowest contact {spent['slowest_number']}: {spent['most']} iterations, the median one {spent['median']:.0f}"


def _exist(experiment: Experiment, data: Path, folder_of: Callable[..., Path]) -> list[bool]:
    """Of each data set, whether its `folder_of` is there."""
    from jaxunshear.data.generation import list_sets

    return [
        folder_of(settings, experiment.sensor, data).exists()
        for settings in list_sets(experiment).values()
    ]


def _train(experiment: Experiment, network: str, folder: Path, data: Path) -> bool:
    """Train one network, or find it trained. Returns whether there was anything to do."""
    from jaxunshear.training.checkpoint import SUMMARY, compute_weights_digest, has_model, load_best

    if (folder / network / SUMMARY).exists():
        if not has_model(folder / network):
            raise UserError(
                f"{folder / network} has lost its checkpoints: delete that folder, then run the same command"
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
    from jaxunshear.training.trainer import Provenance, TrainingData, train

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
    training_data = TrainingData(
        lambda start: map(rename_inputs, batches(start)),
        take_first(examples.reader.split, training.validation_images, fields),
        examples.epoch,
    )
    provenance = Provenance(
        describe_origin(experiment, network),
        list_training_digests(experiment, network, begin),
        InitialWeights(load_best(begin), compute_weights_digest(begin)) if begin else None,
    )
    summary = train(task, training, training_data, seed, folder / network, provenance)
    loss = "unknown" if summary.best_loss is None else f"{summary.best_loss:.5f}"
    print(
        f"{network}: {summary.images} images in {summary.train_seconds:.0f} s ({summary.images_per_second:.0f} a second), "
        f"best validation loss {loss} at step {summary.best_step} of {summary.steps}"
    )
    return True


def _halfway(experiment: Experiment, stage: str, folder: Path, data: Path) -> bool:
    """Whether a stopped run has left work of `stage` to go on with. An evaluation is always done from the start."""
    if stage == "data":
        there = _exist(experiment, data, configs.get_set_folder)
        return not all(there) and any(
            (*there, *_exist(experiment, data, configs.get_unfinished_folder))
        )
    place = folder / stage
    return (
        stage in TRAINABLE
        and (place / "model.json").exists()
        and not (place / "summary.json").exists()
    )


def _keep_time(folder: Path, stage: str, seconds: float) -> None:
    """A stage that is done again from the start counts anew. What a run had spent that was killed outright is lost."""
    write_json(folder / TIMES, read_times(folder) | {stage: round(seconds, 3)})


def print_summary(results: Results, folder: Path) -> None:
    if not results.simulated:
        _print_recorded(results, folder)
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


def _print_recorded(results: Results, folder: Path) -> None:
    """Recordings have any targets: a table for a person, and the file that holds the rest."""
    from jaxunshear.evaluation.other_recordings import format_table
    from jaxunshear.evaluation.score import choose_main_kind

    print(format_table(results))
    if similar := results.ms_ssim:
        felt, unsheared = (
            similar[kind]["overall"] for kind in ("sheared", choose_main_kind(similar))
        )
        print(
            f"{results.metric['ms_ssim']} with the partner: {felt:.3f} as felt, {unsheared:.3f} unsheared"
        )
    print(f"results: {folder / 'results.json'}")
