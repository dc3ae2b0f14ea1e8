"""Engines that run the tasks of a sweep, on this machine or on a Ray cluster."""

import functools
from collections.abc import Callable, Iterator, Sequence

from jaxunshear.cluster import Call, CallRunner, WorkerDied, make_ray_runner, run_locally
from jaxunshear.sweep.tasks import Task, run_task, write_failure

Engine = Callable[[Sequence[Task], Sequence[str]], Iterator[Task]]  # yields tasks as they end


def run_serially(tasks: Sequence[Task], worker: Sequence[str]) -> Iterator[Task]:
    """Run one task at a time, in their order; a task comes after those that it needs."""
    return _run_tasks(run_locally, tasks, worker)


def make_ray_engine(address: str | None, cores: int) -> Engine:
    """Make an engine that runs all tasks at once on a cluster, see `make_ray_runner`.

    Its machines need the folders under the same paths. A task whose worker dies goes on from its
    checkpoint. Raises `UserError` if Ray or the cluster is missing.
    """
    return functools.partial(_run_tasks, make_ray_runner(address, cores))


def _run_tasks(run: CallRunner, tasks: Sequence[Task], worker: Sequence[str]) -> Iterator[Task]:
    by_folder = {task.folder: task for task in tasks}
    calls = (
        Call(task.folder, run_task, (task.folder, task.kind, tuple(worker)), task.needs)
        for task in tasks
    )
    for folder, result in run(calls):
        task = by_folder[folder]
        if isinstance(result, WorkerDied):
            write_failure(task.folder, task.kind, result.reason)
        yield task
