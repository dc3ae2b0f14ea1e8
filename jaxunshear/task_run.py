"""Run an experiment about several tasks: each alone, then one network that unshears all.

    RUN/trained/<task>   the run of that task alone
    RUN/trained/joint    the joint network, which learnt from all tasks
    RUN/<task>           the joint network with the PoseNets of that task: for `pose`, `stream` ...
    RUN/others/<task>    a network that learnt from the other tasks, with the PoseNets of that task

RUN/results.json compares them: `tests` has a table of poses for each task.
"""

import shutil
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple, cast

from jaxunshear.cluster import CallRunner, run_locally
from jaxunshear.config.data import JOINT, Recorded, RecordedTasks
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.network_config import list_trained_networks, resolve_network
from jaxunshear.config.networks import TRAINABLE
from jaxunshear.config.serialization import load_settings
from jaxunshear.config.targets import Target, list_target_names, make_label_targets
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

TRAINED, OTHERS = "trained", "others"  # in the folder of a run
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
        networks = list_trained_networks(task) if is_trained else ()
        run.run(task, ("data", *networks) if "data" in stages or is_trained else (), TRAINED)
    if is_trained:
        _train(run, JOINT, tasks)
    results = _evaluate(run, tasks) if "evaluate" in stages else None
    if "report" in stages:
        from jaxunshear.report.report import write_report

        print(f"report: {write_report(run.folder)}")
    return results


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
    tested = run.source.list_taught_parts()
    joint = _train(run, JOINT, tasks)
    for task in tasks:
        run.run(task, ("evaluate", "report"), TRAINED)
        _assemble(run, task, joint, tested[0], "")
        others = [other for other in tested if other.name != task.name]
        if task in tested and others:
            learnt = _train(run, f"without_{task.name}", others)
            _assemble(run, task, learnt, others[0], OTHERS)
    trained = run.folder / TRAINED / joint.name
    results = finish_results(_collect(run, tested), joint, trained, run.command)
    write_record(run.folder / "results.json", results)
    return results


def _assemble(
    run: _TaskRun, task: Experiment, learnt: Experiment, reference: Experiment, place: str
) -> None:
    """Make and score the run of a task with its own PoseNets and the network of `learnt`.

    That network has the frame of the task `reference`.
    """
    own, target = run.folder / TRAINED / task.name, run.folder / place / task.name
    shift = align_frames(run.read_frame(task), run.read_frame(reference)).shift.tolist()
    target.mkdir(parents=True, exist_ok=True)
    shutil.copy2(own / FRAME, target / FRAME)
    digests = open_source(learnt).list_test_digests()
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
        if any(shares := _list_shares(learnt, task)):
            changes[TASK_SHARES] = shares
        source = run.folder / TRAINED / learnt.name / name
        move_network(source, target / name, changes, shift if uses_pins(task) else [])
    run.run(experiment, ("evaluate", "report"), place)


def _list_shares(learnt: Experiment, task: Experiment) -> list[float]:
    """List which of the tasks that a network learnt `task` is: 1, and 0 else."""
    source = open_source(learnt)
    if not isinstance(source, TaskSource):
        return []
    return [float(part.paired == task.paired) for part in source.list_taught_parts()]


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
        shift = align_frames(run.read_frame(task), run.read_frame(tasks[0]))
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
