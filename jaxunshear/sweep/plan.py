"""The tasks that a sweep has yet to do: trainings that several rows share, then rows.

FOLDER/rows/<label>-<digest>/      a row: its run's files, and row.json once it has ended
FOLDER/shared/<network>-<digest>/  a training that rows share
FOLDER/data/                       the making of the data sets, which lie elsewhere

Imports no JAX.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.load import list_registering_files
from jaxunshear.config.network_config import (
    NetworkConfig,
    list_required_networks,
    list_trained_networks,
    resolve_network,
    resolve_trained_networks,
)
from jaxunshear.config.networks import TRAINABLE
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.data.sources import list_source_files, open_source
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
        files=_list_files(),
    )
    write_record(task.folder / TASK, order)
    return task


def _list_files() -> list[str]:
    """List the experiment files that have registered something; processes of a sweep run them."""
    return sorted({*list_registering_files(), *list_source_files()})


def plan_tasks(
    folder: Path, rows: list[Row], ablation: bool, data: Path, command: str
) -> list[Task]:
    """Plan the unfinished `rows`, after the trainings that they share; writes each task.json."""
    order = TaskOrder(kind="", data=str(data), command=command, files=_list_files())
    trainings = SharedTrainings(folder, rows, order)
    tasks = []
    for row in rows:
        inputs = trainings.request(row)
        task = Task(folder / "rows" / row.experiment.name, "row", tuple(inputs.awaited.values()))
        row_order = replace(
            order,
            kind=task.kind,
            experiment=to_json(row.experiment),
            networks=list_trained_networks(row.experiment),
            sources=inputs.sources,
            ablation=ablation,
            label=row.label,
            seed=row.experiment.seed,
        )
        write_record(task.folder / TASK, row_order)
        tasks.append(task)
    return [*trainings.tasks.values(), *tasks]


class RowInputs(NamedTuple):
    """The trainings that a row copies, by network."""

    sources: dict[str, str]  # their folders
    awaited: dict[str, Path]  # the folders of the tasks that make them, if they are not finished


class SharedTrainings:
    """The tasks of trainings that several rows share, made as rows request them."""

    def __init__(self, folder: Path, rows: list[Row], order: TaskOrder) -> None:
        self.folder, self.order = folder, order
        self.tasks: dict[str, Task] = {}  # by the name of the training
        self._finished = _find_finished_trainings(folder)
        # of each row: the trainings that it has yet to do
        self._configs = {row.digest: _list_missing_trainings(folder, row) for row in rows}
        self._users = Counter(
            format_training_name(config)
            for configs in self._configs.values()
            for config in configs.values()
        )

    def request(self, row: Row) -> RowInputs:
        """Return the trainings that `row` copies; it does the others itself."""
        inputs = RowInputs({}, {})
        for network, config in self._configs[row.digest].items():
            name = format_training_name(config)
            if name in self._finished:
                inputs.sources[network] = str(self._finished[name])
            elif self._users[name] > 1:
                self._request_task(row, config, inputs)
        return inputs

    def _request_task(self, row: Row, config: NetworkConfig, inputs: RowInputs) -> None:
        name, networks = format_training_name(config), list_required_networks(config)
        helpers = networks[:-1]
        needs = tuple(inputs.awaited[helper] for helper in helpers if helper in inputs.awaited)
        task = Task(self.folder / "shared" / name, "training", needs)
        inputs.sources[config.name] = str(task.folder / config.name)
        outcome = read_outcome(task.folder, task.kind)
        if outcome and outcome.status != "done":
            return  # the row fails with the reason of this training
        # an outcome without a finished training: its folder was deleted since
        get_outcome_file(task.folder, task.kind).unlink(missing_ok=True)
        inputs.awaited[config.name] = task.folder
        if name in self.tasks:
            return
        self.tasks[name] = task
        experiment: Settings = to_json(replace(row.experiment, name=name))
        if (task.folder / TASK).exists():  # a stopped sweep began it, maybe for another row
            experiment = read_order(task.folder).experiment or experiment
        sources = {}
        for helper in helpers:
            helper_name = format_training_name(resolve_network(row.experiment, helper))
            if source := self._finished.get(helper_name, inputs.sources.get(helper)):
                sources[helper] = str(source)
        order = replace(
            self.order,
            kind=task.kind,
            experiment=experiment,
            networks=networks,
            sources=sources,
        )
        write_record(task.folder / TASK, order)


def _list_missing_trainings(folder: Path, row: Row) -> dict[str, NetworkConfig]:
    run = folder / "rows" / row.experiment.name
    return {
        config.name: config
        for config in resolve_trained_networks(row.experiment)
        if not (run / config.name / FINISHED).exists()
    }


def _find_finished_trainings(folder: Path) -> dict[str, Path]:
    """Find all finished trainings in a sweep's folder, by their names.

    Trainings that are damaged, or of an earlier version, are left out and trained again.
    """
    trainings: dict[str, Path] = {}
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
            trainings.setdefault(name, path / network)
    return trainings
