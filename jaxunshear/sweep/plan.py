"""What a sweep has yet to do: its unfinished rows, before them the trainings that several of them share. Imports no JAX.

FOLDER/rows/<label>-<digest>/      a row: its run's files, and row.json once it has ended
FOLDER/shared/<network>-<digest>/  a training that rows share
FOLDER/data/                       the making of the data sets, which lie elsewhere
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from jaxunshear.config.experiment import Experiment, list_required_networks, list_trained_networks
from jaxunshear.config.losses import list_registering_files
from jaxunshear.config.registry import TRAINABLE
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.config.training import uses_teacher
from jaxunshear.errors import UserError
from jaxunshear.files import read_object
from jaxunshear.results.record_files import write_record
from jaxunshear.sweep.grid import Row, select_training_part
from jaxunshear.sweep.tasks import TASK, Task, TaskOrder, get_outcome_file, read_outcome
from jaxunshear.training.data_origin import check_origin

FINISHED = "summary.json"  # of a training
NON_DATA_SETTINGS = (
    *("name", "claim", "seed", "targets", "unshear", "posenet", "pins"),
    *("train", "train_posenet", "train_teacher", "train_pins"),
)


def find_row_folder(folder: Path, row: Row) -> Path:
    """Where `row` is or will be; one that an earlier sweep gave another label stays where it is."""
    there = sorted((folder / "rows").glob(f"*-{row.digest}"))
    return there[0] if there else folder / "rows" / row.experiment.name


def forget_failures(folder: Path, rows: Iterable[Row]) -> None:
    """Takes failed rows, and the shared trainings that failed, for unfinished: they are tried again."""
    tried = [(find_row_folder(folder, row), "row") for row in rows]
    tried += [(path, "training") for path in (folder / "shared").glob("*/")]
    for path, kind in tried:
        outcome = read_outcome(path, kind)
        if outcome and outcome.status == "failed":
            get_outcome_file(path, kind).unlink()


def list_unfinished(folder: Path, rows: Iterable[Row]) -> list[Row]:
    """The rows without an outcome, each once, named as their folders are."""
    found = {}
    for row in rows:
        path = find_row_folder(folder, row)
        if not get_outcome_file(path, "row").exists():
            found[row.digest] = replace(row, experiment=replace(row.experiment, name=path.name))
    return list(found.values())


def make_data_task(folder: Path, rows: list[Row], data: Path) -> Task:
    """Making, or finding made, each data set that `rows` need, once."""
    experiments = []
    for row in rows:
        plain = {
            field: getattr(Experiment(name="", claim=""), field) for field in NON_DATA_SETTINGS
        }
        if uses_teacher(row.experiment.train):  # it needs its taps, whatever its weight
            plain["train"] = replace(plain["train"], losses={"pose_tap": 1.0})
        experiment = to_json(replace(row.experiment, **plain))
        if experiment not in experiments:
            experiments.append(experiment)
    task = Task(folder / "data", "data")
    get_outcome_file(task.folder, task.kind).unlink(
        missing_ok=True
    )  # a set may have been deleted since
    write_record(
        task.folder / TASK, TaskOrder(kind=task.kind, experiments=experiments, data=str(data))
    )
    return task


def plan_tasks(
    folder: Path, rows: list[Row], ablation: bool, data: Path, command: str
) -> list[Task]:
    """The tasks of the unfinished `rows`, the trainings that they share before them; writes each one's task.json."""
    order = TaskOrder(kind="", data=str(data), command=command, files=list_registering_files())
    finished = _finished_trainings(folder)
    parts = {
        (row.digest, network): select_training_part(row.experiment, network)
        for row in rows
        for network in list_trained_networks(row.experiment)
        if not (folder / "rows" / row.experiment.name / network / FINISHED).exists()
    }
    users = Counter(part.name for part in parts.values())
    shared: dict[str, Task] = {}
    tasks = []
    for row in rows:
        sources: dict[str, str] = {}
        awaited: dict[str, Path] = {}
        for network in list_trained_networks(row.experiment):
            part = parts.get((row.digest, network))
            if part is None:
                continue
            first = list_required_networks(part, network)[:-1]  # its teacher, if it has one
            own = Task(
                folder / "shared" / part.name,
                "training",
                tuple(awaited[n] for n in first if n in awaited),
            )
            if part.name in finished:
                sources[network] = str(finished[part.name])
            elif users[part.name] > 1:
                sources[network] = str(own.folder / network)
                outcome = read_outcome(own.folder, own.kind)
                if (
                    outcome is None or outcome.status == "done"
                ):  # done, but its folder was deleted since
                    get_outcome_file(own.folder, own.kind).unlink(missing_ok=True)
                    awaited[network] = own.folder
                    if part.name not in shared:
                        shared[part.name] = own
                        places = {
                            n: finished.get(
                                select_training_part(row.experiment, n).name, sources.get(n)
                            )
                            for n in first
                        }
                        copied = {n: str(place) for n, place in places.items() if place}
                        asked = replace(order, networks=(*first, network), sources=copied)
                        write_record(
                            own.folder / TASK,
                            replace(asked, kind=own.kind, experiment=to_json(part)),
                        )
        task = Task(folder / "rows" / row.experiment.name, "row", tuple(awaited.values()))
        asked = replace(
            order,
            networks=list_trained_networks(row.experiment),
            sources=sources,
            ablation=ablation,
        )
        asked = replace(asked, label=row.label, seed=row.experiment.seed)
        write_record(
            task.folder / TASK, replace(asked, kind=task.kind, experiment=to_json(row.experiment))
        )
        tasks.append(task)
    return [*shared.values(), *tasks]


def _finished_trainings(folder: Path) -> dict[str, Path]:
    """Folders of all trainings that were finished in this sweep's folder, by the names of their parts."""
    found: dict[str, Path] = {}
    for path in sorted([*(folder / "shared").glob("*/"), *(folder / "rows").glob("*/")]):
        done = [network for network in TRAINABLE if (path / network / FINISHED).exists()]
        if not done:
            continue
        try:
            experiment = from_json(read_object(path / "experiment.json"))
        except UserError:
            continue  # of another version: its trainings are not those of today
        for network in done:
            try:
                check_origin(experiment, network, path)
            except UserError:
                continue  # damaged, or of an earlier version of the data: trained again where it is needed
            found.setdefault(select_training_part(experiment, network).name, path / network)
    return found
