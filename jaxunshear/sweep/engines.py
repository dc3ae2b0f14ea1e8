"""Who does the tasks of a sweep: this machine, one after the other, or a Ray cluster. Both yield them as they end."""

import functools
from collections.abc import Callable, Iterator, Sequence

from jaxunshear.cluster import Call, CallRunner, WorkerDied, make_ray_runner, run_locally
from jaxunshear.sweep.tasks import Task, run_task, write_failure

Engine = Callable[[Sequence[Task], Sequence[str]], Iterator[Task]]


def run_serially(tasks: Sequence[Task], worker: Sequence[str]) -> Iterator[Task]:
    """One task at a time, in their order: a task comes after those that it needs."""
    return _spread(run_locally, tasks, worker)


def make_ray_engine(address: str | None, cores: int) -> Engine:
    """All tasks at once on a cluster (see `make_ray_runner`) whose machines see the folders under the same paths.

    A task whose worker dies goes on from its checkpoint. Raises `UserError` where Ray or the cluster is missing.
    """
    return functools.partial(_spread, make_ray_runner(address, cores))


def _spread(spread: CallRunner, tasks: Sequence[Task], worker: Sequence[str]) -> Iterator[Task]:
    which = {task.folder: task for task in tasks}
    calls = (
        Call(task.folder, run_task, (task.folder, task.kind, tuple(worker)), task.needs)
        for task in tasks
    )
    for folder, made in spread(calls):
        task = which[folder]
        if isinstance(made, WorkerDied):
            write_failure(task.folder, task.kind, made.reason)
        yield task
