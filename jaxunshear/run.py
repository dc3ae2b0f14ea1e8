"""Run the stages of an experiment: data, trainings, evaluation, report.

Every stage writes its work to one folder and finds it there again, so the same command continues a
stopped run.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from jaxunshear.cluster import CallRunner, run_locally
from jaxunshear.config import configs
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.networks import TRAINABLE
from jaxunshear.config.serialization import add_version, check_unreleased, from_json, to_json
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.files import hold_lock, read_object, write_json
from jaxunshear.results.record_files import TIMES, read_times
from jaxunshear.results.run import Results
from jaxunshear.training.provenance import (
    InitialWeights,
    check_origin,
    list_training_digests,
    start_folder,
)

LOCK = "run.lock"  # a row of a sweep has another lock


def run_stages(
    experiment: Experiment,
    stages: tuple[str, ...],
    out: Path,
    data: Path,
    command: str,
    run_calls: CallRunner = run_locally,
) -> Results | None:
    """Run `stages` ("data", names of networks, "evaluate", "report") into out/<name>.

    Returns the results if they were evaluated. Raises UserError for whatever a person can fix, and
    if another process is at work in that folder.

    Args:
        data: folder of the data sets.
        command: the command line, which the results state.
        run_calls: how the simulation of data is run, in one process or several.
    """
    for network in TRAINABLE:
        if network in stages:
            start_folder(experiment, network)  # raises before data are made for nothing
    folder = Path(out) / experiment.name
    check_unreleased(folder.absolute(), "give another --out or --name")  # a path, never a name
    with hold_lock(folder / LOCK, wait=False) as free:
        if not free:
            raise UserError(
                f"another run is at work in {folder}: wait for it, stop it, or give another --out"
            )
        _write_settings(experiment, folder)
        run = _Run(experiment, folder, Path(data), command, run_calls)
        results = None
        for stage in stages:
            results = _run_stage(run, stage) or results
        return results


@dataclass(frozen=True)
class _Run:
    """One run in its folder, with the folder `data` of the data sets."""

    experiment: Experiment
    folder: Path
    data: Path
    command: str
    run_calls: CallRunner


def _run_stage(run: _Run, stage: str) -> Results | None:
    results = None
    seconds = read_times(run.folder).get(stage, 0.0) if _can_continue(run, stage) else 0.0
    began, worked = time.perf_counter(), False
    try:
        if stage == "data":
            worked = _make_data(run)
        elif stage in TRAINABLE:
            worked = _train(run, stage)
        elif stage == "evaluate":
            from jaxunshear.evaluation.evaluate import evaluate

            results, worked = evaluate(run.experiment, run.folder, run.data, run.command), True
            print_summary(results, run.folder)
        else:
            from jaxunshear.report.report import write_report

            # its time is not written, because the report, which shows the times, cannot have it
            print(f"report: {write_report(run.folder)}")
    finally:
        # also of a stopped stage that the next run continues; a process that is killed writes none
        if worked or _can_continue(run, stage):
            seconds += time.perf_counter() - began
            write_json(run.folder / TIMES, read_times(run.folder) | {stage: round(seconds, 3)})
    return results


def _write_settings(experiment: Experiment, folder: Path) -> None:
    """Write experiment.json. Raises UserError if the folder has work of another experiment."""
    path = folder / "experiment.json"
    settings = to_json(experiment)
    started = any(file.name not in (path.name, LOCK, TIMES) for file in folder.iterdir())
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
            (folder / TIMES).unlink(missing_ok=True)  # the times are of other data
    write_json(path, add_version(settings))


def _make_data(run: _Run) -> bool:
    from jaxunshear.data.simulation import make_engine

    complete = all(_list_existing(run, configs.get_set_folder))
    engine = make_engine(run.run_calls)
    sets = open_source(run.experiment).make_sets(run.data, engine)
    for name, metadata in sets.items():
        counts = metadata["counts"]
        written = ", ".join(f"{count} of {split}" for split, count in counts["written"].items())
        text = f"{name}: contacts {written}; {counts['dropped']} left out"
        if iterations := counts.get("iterations"):  # recordings have none
            text += (
                f"; slowest contact {iterations['slowest_number']}: {iterations['most']} "
                f"iterations, the median one {iterations['median']:.0f}"
            )
        print(text)
    return not complete


def _list_existing(run: _Run, get_folder: Callable[..., Path]) -> list[bool]:
    sensor, sets = run.experiment.sensor, open_source(run.experiment).list_sets().values()
    return [get_folder(settings, sensor, run.data).exists() for settings in sets]


def _has_training(run: _Run, network: str) -> bool:
    """Return whether a network is trained to the end, from this data. Raises UserError."""
    from jaxunshear.training.checkpoint import SUMMARY, check_checkpoints

    folder = run.folder / network
    if not (folder / SUMMARY).exists():
        return False
    check_checkpoints(folder)
    check_origin(run.experiment, network, run.folder)
    return True


def _train(run: _Run, network: str) -> bool:
    if _has_training(run, network):
        return False
    from jaxunshear.training.examples import (
        FRAME,
        add_single_contacts,
        open_examples,
        rename_inputs,
        select_few_pairs,
        take_first,
    )
    from jaxunshear.training.task_factory import make_task
    from jaxunshear.training.trainer import Provenance, TrainingData, train

    experiment, folder = run.experiment, run.folder / network
    source, config = open_source(experiment), resolve_network(experiment, network)
    training, seed = config.training, config.seed
    all_examples = open_examples(experiment, network, run.data, run.folder)
    if frame := source.read_frame(run.data):
        write_json(run.folder / FRAME, frame)
    examples = all_examples
    if training.paired_share < 1:
        examples = select_few_pairs(all_examples, training.paired_share, seed)
    task, fields = make_task(experiment, network, examples, run.folder)
    batches = examples.reader.train_batches(training.batch, seed, training.shift, fields)
    batches = add_single_contacts(batches, config, all_examples, run.data)
    start = start_folder(experiment, network)
    training_data = TrainingData(
        lambda step: map(rename_inputs, batches(step)),
        take_first(examples.reader.split, training.validation_images, fields),
        examples.per_epoch,
    )
    digests = list_training_digests(experiment, network, start)
    count = examples.tasks if config.modality == "pins" else 0
    weights = _load_initial_weights(start, count) if start else None
    provenance = Provenance(source.describe_origin(config), digests, weights)
    summary = train(task, training, training_data, seed, folder, provenance)
    loss = "unknown" if summary.best_loss is None else f"{summary.best_loss:.5f}"
    print(
        f"{network}: {summary.images} images in {summary.train_seconds:.0f} s "
        f"({summary.images_per_second:.0f} a second), "
        f"best validation loss {loss} at step {summary.best_step} of {summary.steps}"
    )
    return True


def _load_initial_weights(folder: Path, tasks: int) -> InitialWeights:
    """Load weights to start from, of one task; with several `tasks` they serve all alike."""
    from jaxunshear.models.pin_networks import unfold_tasks
    from jaxunshear.training.checkpoint import compute_weights_digest, load_network

    weights = load_network(folder).variables
    digest = compute_weights_digest(weights)
    return InitialWeights(unfold_tasks(weights, tasks) if tasks > 1 else weights, digest)


def _can_continue(run: _Run, stage: str) -> bool:
    """Return whether a stopped run has left work of `stage` that can be continued."""
    if stage == "data":
        complete = _list_existing(run, configs.get_set_folder)
        partial = _list_existing(run, configs.get_unfinished_folder)
        return not all(complete) and any((*complete, *partial))
    folder = run.folder / stage
    return (
        stage in TRAINABLE
        and (folder / "model.json").exists()
        and not (folder / "summary.json").exists()
    )


def print_summary(results: Results, folder: Path) -> None:
    """Print scores and errors of each kind of image, and the bars that the run met or missed."""
    if results.recordings is not None:
        _print_recordings(results, folder)
        return
    from jaxunshear.evaluation.measurements import build_measurements
    from jaxunshear.evaluation.score import BASELINES
    from jaxunshear.report import wording
    from jaxunshear.text_table import format_text_table

    likeness, errors, name = results.ms_ssim, results.pose_mae, str(results.metric["ms_ssim"])
    rows = [
        {
            "": wording.KINDS[kind],
            name: likeness.get(kind, {}).get("overall"),
            **errors.get(kind, {}),
        }
        for kind in wording.KINDS
        if kind in (*likeness, *errors) and kind not in BASELINES
    ]
    print(format_text_table(rows, ("", name, *wording.list_targets(results))))
    for row in build_measurements(replace(results, tests={})).rows:
        if row.bar is not None:
            met = "met" if row.ok else "MISSED"
            print(f"{row.name} {row.value} {row.unit} (bar {row.sense} {row.bar}: {met})")
    print(f"results: {folder / 'results.json'}")


def _print_recordings(results: Results, folder: Path) -> None:
    """Print a table of the errors, whose targets the labels decide, and where the rest is."""
    from jaxunshear.evaluation.recorded_results import format_table
    from jaxunshear.evaluation.score import choose_main_kind

    print(format_table(results))
    if similar := results.ms_ssim:
        sheared = similar["sheared"]["overall"]
        unsheared = similar[choose_main_kind(similar)]["overall"]
        print(
            f"{results.metric['ms_ssim']} with the partner: "
            f"{sheared:.3f} sheared, {unsheared:.3f} unsheared"
        )
    print(f"results: {folder / 'results.json'}")
