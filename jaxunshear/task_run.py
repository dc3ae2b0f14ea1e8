"""Run an experiment about several tasks: each alone, then one network that unshears all.

    RUN/trained/<task>   the run of that task alone
    RUN/trained/joint    the joint network, which learnt from all tasks
    RUN/<task>           the joint network with the PoseNets of that task: for `pose`, `stream` ...
    RUN/others/<task>    a network that learnt from the other tasks, with the PoseNets of that task
    RUN/taps_alone/<task>    one that learnt from taps of that task, too, by `score_taps_alone`

RUN/results.json compares them: `tests` has a table of poses for each task.
"""

import shutil
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple, cast

from jaxunshear.cluster import CallRunner, run_locally
from jaxunshear.config.data import JOINT, TASK_FOLDERS, Recorded, RecordedTasks
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.network_config import (
    list_required_networks,
    list_trained_networks,
    resolve_network,
)
from jaxunshear.config.networks import TEACHER, TRAINABLE
from jaxunshear.config.serialization import load_settings
from jaxunshear.config.targets import Target, list_target_names, make_label_targets
from jaxunshear.config.training import uses_teacher
from jaxunshear.data.recordings import read_recordings
from jaxunshear.data.sources import open_source
from jaxunshear.data.task_source import TaskSource, align_frames
from jaxunshear.errors import Note, UserError
from jaxunshear.evaluation.result_tables import finish_results
from jaxunshear.files import Json, read_object
from jaxunshear.results.record_files import read_record, read_times, write_record
from jaxunshear.results.run import EVALUATE_REMEDY, FurtherTest, Results, TaskFrame
from jaxunshear.run import run_stages
from jaxunshear.training.checkpoint import TASK_SHARES, move_network, read_targets
from jaxunshear.training.examples import FRAME
from jaxunshear.training.provenance import list_training_digests

_, TRAINED, OTHERS, TAPS_ALONE = TASK_FOLDERS  # in the folder of a run
UNSHEARED = "unsheared"
# kinds of the joint table: by the folder of the run that they come from, their kinds there
ROWS = {
    TRAINED: {**{kind: kind for kind in ("tap", "sheared", "sheared_learnt")}, "own": UNSHEARED},
    OTHERS: {OTHERS: UNSHEARED},
    "": {UNSHEARED: UNSHEARED},
}


class _TaskRun(NamedTuple):
    """A run about several tasks, with the arguments of `run_stages`."""

    experiment: Experiment
    source: TaskSource
    folder: Path
    data: Path
    command: str
    run_calls: CallRunner

    def run(self, experiment: Experiment, stages: tuple[str, ...], place: str = "") -> None:
        """Run stages of another experiment in a folder of this run."""
        out = self.folder / place
        run_stages(experiment, stages, out, self.data, self.command, self.run_calls)

    def read_frame(self, task: Experiment) -> Json:
        return read_object(self.folder / TRAINED / task.name / FRAME)


def run_tasks(
    experiment: Experiment,
    stages: tuple[str, ...],
    out: Path,
    data: Path,
    command: str,
    run_calls: CallRunner = run_locally,
) -> Results | None:
    """Run `stages` of an experiment about several tasks, as `run_stages` does of others."""
    source = open_source(experiment)
    assert isinstance(source, TaskSource)  # whose runner this is
    run = _TaskRun(experiment, source, Path(out) / experiment.name, Path(data), command, run_calls)
    tasks, is_trained = source.list_parts(), not TRAINABLE.isdisjoint(stages)
    run_stages(experiment, (), out, data, command, run_calls)  # writes its settings
    for task in tasks:
        networks = _list_networks(experiment, task) if is_trained else ()
        run.run(task, ("data", *networks) if "data" in stages or is_trained else (), TRAINED)
    if is_trained:
        _train(run, JOINT, tasks)
    results = _evaluate(run, tasks) if "evaluate" in stages else None
    if "report" in stages:
        from jaxunshear.report.report import write_report

        print(f"report: {write_report(run.folder)}")
    return results


def score_taps_alone(run_dir: Path, data: Path, command: str) -> None:
    """Score, of each task of a finished run, a network that has seen no slide of it.

    It learns from the slides of the other tasks, and from the taps of this one with slides that are
    transferred to them. Results are in RUN/taps_alone/<task>. Raises UserError.
    """
    source = open_source(load_settings(run_dir))
    if not isinstance(source, TaskSource) or not uses_pins(source.experiment):
        raise UserError(f"{run_dir} is not about several tasks over pins: name a run that is")
    tested = source.list_parts_with_slides()
    if len(tested) < 2:
        raise UserError(f"{run_dir} has one task with slides: name a run that has two or more")
    run = _TaskRun(source.experiment, source, run_dir, data, command, run_locally)
    for task in tested:
        open_source(task).make_sets(data)
        alone = replace(task, paired=replace(cast(Recorded, task.paired), slide_folder=""))
        parts = [alone if part.name == task.name else part for part in source.list_parts()]
        learnt = _train(run, f"taps_of_{task.name}", parts)
        _assemble(run, task, learnt, TAPS_ALONE)


def find_task(run_dir: Path, recordings: Path) -> Path:
    """Find the task of a run whose labels vary as those of recordings do; return its folder.

    Of several such tasks it is the first. Raises UserError if there is none.
    """
    source = open_source(load_settings(run_dir))
    assert isinstance(source, TaskSource)
    poses = read_recordings(recordings, source.settings.preprocess).poses
    varying = () if poses is None else list_target_names(make_label_targets((), poses))
    names = {}
    for task in source.list_parts():
        targets = read_targets(run_dir / task.name / task.networks[-1])
        names[task.name] = list_target_names(targets)
    found = [task for task, targets in names.items() if set(targets) == set(varying)]
    if not found:
        known = "; ".join(f"{task}: {', '.join(targets)}" for task, targets in names.items())
        raise UserError(
            f"{recordings}: {', '.join(varying) or 'no label'} varies, as in no task of {run_dir} "
            f"({known}): name the folder of a task, such as {run_dir / next(iter(names))}"
        )
    if len(found) > 1:
        note = f"{recordings} is scored as task {found[0]}; labels vary so in {', '.join(found)}"
        warnings.warn(f"{note}: name {run_dir / found[1]} for another", Note, stacklevel=2)
    return run_dir / found[0]


def _list_networks(experiment: Experiment, task: Experiment) -> tuple[str, ...]:
    """List the networks to train of a task, with a teacher of the joint network."""
    names = task.networks
    trainings = [resolve_network(experiment, name).training for name in experiment.networks]
    if any(map(uses_teacher, trainings)):
        names = (TEACHER, *names)
    return list_required_networks(*(resolve_network(task, name) for name in names))


def _train(run: _TaskRun, name: str, tasks: list[Experiment]) -> Experiment:
    """Train a network on some tasks, or take that of a single one; return its experiment."""
    if len(tasks) == 1:
        return tasks[0]
    parts = tuple(cast(Recorded, task.paired) for task in tasks)
    paired = RecordedTasks(parts, tuple(task.name for task in tasks))
    experiment = replace(run.experiment, name=name, paired=paired)
    out = run.folder / TRAINED
    networks = list_trained_networks(experiment)
    run_stages(experiment, networks, out, run.data, run.command, run.run_calls)
    return experiment


def _evaluate(run: _TaskRun, tasks: list[Experiment]) -> Results:
    """Make the model of each task; score networks of all and of the other tasks on its slides."""
    tested = run.source.list_parts_with_slides()
    joint = _train(run, JOINT, tasks)
    for task in tasks:
        run.run(task, ("evaluate", "report"), TRAINED)
        _assemble(run, task, joint, "")
        others = [other for other in tested if other.name != task.name]
        if task in tested and others:
            learnt = _train(run, f"without_{task.name}", others)
            _assemble(run, task, learnt, OTHERS)
    trained = run.folder / TRAINED / joint.name
    results = finish_results(_collect(run, tested), joint, trained, run.command)
    write_record(run.folder / "results.json", results)
    return results


def _assemble(run: _TaskRun, task: Experiment, learnt: Experiment, place: str) -> None:
    """Make and score the run of a task with its own PoseNets and the network of `learnt`."""
    source = open_source(learnt)
    taught = source.list_taught_parts() if isinstance(source, TaskSource) else []
    reference = taught[0] if taught else learnt  # whose frame that network has
    own, target = run.folder / TRAINED / task.name, run.folder / place / task.name
    shift = align_frames(run.read_frame(task), run.read_frame(reference)).shift.tolist()
    target.mkdir(parents=True, exist_ok=True)
    shutil.copy2(own / FRAME, target / FRAME)
    digests = source.list_test_digests()
    others = tuple(sorted(digests - open_source(task).list_test_digests()))
    joined = run.experiment.networks
    experiment = replace(
        task,
        networks=tuple(dict.fromkeys((*joined, *task.networks))),
        paired=replace(cast(Recorded, task.paired), others=others),
    )
    for folder in own.iterdir():
        if folder.name in TRAINABLE and folder.name not in joined:
            shutil.copytree(folder, target / folder.name, dirs_exist_ok=True)
    for name in joined:
        origin = open_source(experiment).describe_origin(resolve_network(experiment, name))
        changes: Json = {"origin": origin, "data": list_training_digests(learnt, name, None)}
        if any(shares := [float(part.name == task.name) for part in taught]):
            changes[TASK_SHARES] = shares
        trained = run.folder / TRAINED / learnt.name / name
        move_network(trained, target / name, changes, shift if uses_pins(task) else [])
    run.run(experiment, ("evaluate", "report"), place)


def _collect(run: _TaskRun, tasks: list[Experiment]) -> Results:
    """Collect the tables of poses of all runs of each task."""
    tests, frames = {}, {}
    targets: dict[str, Target] = {}
    for task in tasks:
        pose_mae, intervals = {}, {}
        for place, kinds in ROWS.items():
            file = run.folder / place / task.name / "results.json"
            if not file.exists():  # there is but one task with slides
                continue
            scores = read_record(file, Results, EVALUATE_REMEDY)
            for row, kind in kinds.items():
                if kind in scores.pose_mae:
                    pose_mae[row] = scores.pose_mae[kind]
                    intervals[row] = scores.spread.pose_mae[kind]
        spread = replace(scores.spread, pose_mae=intervals, ms_ssim={}, difference={}, readers={})
        contacts = scores.counts.test_poses or 0
        tests[task.name] = FurtherTest(pose_mae=pose_mae, spread=spread, contacts=contacts)
        targets |= {target.name: target for target in scores.targets or ()}
    taught = run.source.list_taught_parts()
    for task in taught:
        shift = align_frames(run.read_frame(task), run.read_frame(taught[0]))
        frames[task.name] = TaskFrame(shift.shift.tolist(), shift.left_px)
    return Results(
        experiment=run.experiment.name,
        claim=run.experiment.claim,
        simulated=False,
        settings=asdict(run.experiment),
        metric={"pose_mae": scores.metric["pose_mae"]},
        pin_error={},
        tests=tests,
        test_data="same session",
        targets=list(targets.values()),
        frames=frames,
        time_s=read_times(run.folder / TRAINED / JOINT),
    )
