"""The tasks that a sweep has yet to do: trainings that several rows share, then rows.

FOLDER/rows/<label>-<digest>/      a row: its run's files, and row.json once it has ended
FOLDER/shared/<network>-<digest>/  a training that rows share
FOLDER/data/                       the making of the data sets, which lie elsewhere

Imports no JAX.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import (
    NetworkConfig,
    list_required_networks,
    list_trained_networks,
    resolve_network,
    resolve_trained_networks,
)
from jaxunshear.config.networks import TRAINABLE
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.config.types import list_registering_files
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.files import read_object
from jaxunshear.results.record_files import write_record
from jaxunshear.results.run import Settings
from jaxunshear.sweep.grid import Row, format_training_name
from jaxunshear.sweep.tasks import TASK, Task, TaskOrder, get_outcome_file, read_order, read_outcome
from jaxunshear.training.provenance import check_origin

FINISHED = "summary.json"  # of a training


def find_row_folder(folder: Path, row: Row) -> Path:
    """Find the folder of `row`; one that an earlier sweep gave another label stays in place."""
    existing = sorted((folder / "rows").glob(f"*-{row.digest}"))
    return existing[0] if existing else folder / "rows" / row.experiment.name


def forget_failures(folder: Path, rows: Iterable[Row]) -> None:
    """Delete the outcomes of failed rows and shared trainings, so that they are tried again."""
    tasks = [(find_row_folder(folder, row), "row") for row in rows]
    tasks += [(path, "training") for path in (folder / "shared").glob("*/")]
    for path, kind in tasks:
        outcome = read_outcome(path, kind)
        if outcome and outcome.status == "failed":
            get_outcome_file(path, kind).unlink()


def list_unfinished_rows(folder: Path, rows: Iterable[Row]) -> list[Row]:
    """List the rows without an outcome, each once, named as their folders are."""
    unfinished = {}
    for row in rows:
        path = find_row_folder(folder, row)
        if not get_outcome_file(path, "row").exists():
            experiment = replace(row.experiment, name=path.name)
            unfinished[row.digest] = replace(row, experiment=experiment)
    return list(unfinished.values())


def make_data_task(folder: Path, rows: list[Row], data: Path) -> Task:
    """Make the task that makes, or finds, each data set that `rows` need."""
    # by their sets: the first experiment that needs these
    experiments: dict[str, Experiment] = {}
    for row in rows:
        sets = open_source(row.experiment).list_sets()
        experiments.setdefault(f"{row.experiment.sensor} {sets}", row.experiment)
    task = Task(folder / "data", "data")
    # a set may have been deleted since it was made
    get_outcome_file(task.folder, task.kind).unlink(missing_ok=True)
    order = TaskOrder(
        kind=task.kind,
        experiments=[*map(to_json, experiments.values())],
        data=str(data),
        files=list_registering_files(),
    )
    write_record(task.folder / TASK, order)
    return task


def plan_tasks(
    folder: Path, rows: list[Row], ablation: bool, data: Path, command: str
) -> list[Task]:
    """Plan the unfinished `rows`, after the trainings that they share; writes each task.json."""
    order = TaskOrder(kind="", data=str(data), command=command, files=list_registering_files())
    finished = _find_finished_trainings(folder)
    missing = [_list_missing_trainings(folder, row) for row in rows]
    users = Counter(format_training_name(config) for config in itertools.chain(*missing))
    shared: dict[str, Task] = {}  # trainings by name
    tasks = []
    for row, configs in zip(rows, missing, strict=True):
        # by network: the folder of the training that the row copies, and of the task that makes it
        sources: dict[str, str] = {}
        awaited: dict[str, Path] = {}
        for config in configs:
            name = format_training_name(config)
            if name in finished:
                sources[config.name] = finished[name]
            elif users[name] > 1:
                needs = (awaited.get(helper) for helper in list_required_networks(config))
                task = Task(folder / "shared" / name, "training", tuple(filter(None, needs)))
                if name not in shared and _can_start(task):
                    shared[name] = task
                    _order_training(task, order, row, config, sources | finished)
                sources[config.name] = str(task.folder / config.name)
                if name in shared:  # else the row fails with the reason of this training
                    awaited[config.name] = task.folder
        task = Task(folder / "rows" / row.experiment.name, "row", tuple(awaited.values()))
        row_order = replace(
            order,
            kind=task.kind,
            experiment=to_json(row.experiment),
            networks=list_trained_networks(row.experiment),
            sources=sources,
            ablation=ablation,
            label=row.label,
            seed=row.experiment.seed,
        )
        write_record(task.folder / TASK, row_order)
        tasks.append(task)
    return [*shared.values(), *tasks]


def _can_start(task: Task) -> bool:
    """Return whether a training has not failed; an outcome without its folder is removed."""
    outcome = read_outcome(task.folder, task.kind)
    if outcome and outcome.status != "done":
        return False
    get_outcome_file(task.folder, task.kind).unlink(missing_ok=True)
    return True


def _order_training(
    task: Task, order: TaskOrder, row: Row, config: NetworkConfig, sources: Mapping[str, str]
) -> None:
    """Write the task.json of a training; `sources` are folders by network, or by name."""
    experiment: Settings = to_json(replace(row.experiment, name=task.folder.name))
    if (task.folder / TASK).exists():  # a stopped sweep began it, maybe for another row
        experiment = read_order(task.folder).experiment or experiment
    networks, copied = list_required_networks(config), {}
    for helper in networks[:-1]:
        name = format_training_name(resolve_network(row.experiment, helper))
        if source := sources.get(name, sources.get(helper)):
            copied[helper] = source
    order = replace(order, kind=task.kind, experiment=experiment, networks=networks, sources=copied)
    write_record(task.folder / TASK, order)


def _list_missing_trainings(folder: Path, row: Row) -> list[NetworkConfig]:
    run = folder / "rows" / row.experiment.name
    configs = resolve_trained_networks(row.experiment)
    return [config for config in configs if not (run / config.name / FINISHED).exists()]


def _find_finished_trainings(folder: Path) -> dict[str, str]:
    """Find the finished and sound trainings of this version in a folder, by their names."""
    trainings: dict[str, str] = {}
    for path in sorted([*(folder / "shared").glob("*/"), *(folder / "rows").glob("*/")]):
        networks = [network for network in TRAINABLE if (path / network / FINISHED).exists()]
        if not networks:
            continue
        try:
            experiment = from_json(read_object(path / "experiment.json"))
        except UserError:
            continue
        for network in networks:
            try:
                check_origin(experiment, network, path)
            except UserError:
                continue
            name = format_training_name(resolve_network(experiment, network))
            trainings.setdefault(name, str(path / network))
    return trainings
