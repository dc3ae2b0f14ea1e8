"""Who does the tasks of a sweep: this machine, one after the other, or a Ray cluster. Both yield them as they end."""

import functools
import importlib.util
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.sweep.tasks import Task, carry_out, give_up

Engine = Callable[[Sequence[Task], Sequence[str]], Iterator[Task]]
RETRIES = 5  # of a task whose worker died; it goes on from its checkpoint


def serial(tasks: Sequence[Task], worker: Sequence[str]) -> Iterator[Task]:
    """One task at a time, in their order: a task comes after those that it needs."""
    for task in tasks:
        carry_out(task.folder, task.kind, worker)
        yield task


def ray_engine(address: str | None, cores: int) -> Engine:
    """An engine that does all tasks at once on the cluster at `address`, or on one made on this machine; `cores` for each.

    Its machines must see the folders under the same paths. Where the cluster has GPUs, a task gets one.
    Raises `UserError` at once where Ray is missing or nothing listens at the address.
    """
    if importlib.util.find_spec("ray") is None:
        raise UserError("--engine ray needs Ray: pip install -c constraints.txt '.[ray]'")
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon:  # else None, or "auto": Ray searches for a cluster on this machine
        try:
            socket.create_connection((host, int(port)), timeout=10).close()  # Ray itself would try for minutes
        except (OSError, ValueError) as error:
            raise UserError(f"--ray-address {address}: no cluster answers there ({error})") from error
    return functools.partial(_over_ray, address=address, cores=cores)


def _over_ray(tasks: Sequence[Task], worker: Sequence[str], address: str | None, cores: int) -> Iterator[Task]:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # says nothing to anyone unless asked to
    os.environ.setdefault("RAY_task_oom_retries", str(RETRIES))  # else without end
    import ray

    try:
        ray.init(address=address or "local", include_dashboard=False if address is None else None, log_to_driver=False)
    except Exception as error:
        raise UserError(
            f"--ray-address {address or 'local'}: Ray cannot be reached ({' '.join(str(error).split())})"
        ) from error
    try:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        largest = max(node.get("CPU", 1) for node in nodes)
        gpus = 1 if any(node.get("GPU", 0) >= 1 for node in nodes) else 0
        remote = ray.remote(num_cpus=min(cores, largest), num_gpus=gpus, max_retries=RETRIES)(_after)
        doing: dict[Path, ray.ObjectRef] = {}
        for task in tasks:
            needs = [doing[folder] for folder in task.needs]
            doing[task.folder] = remote.remote(str(task.folder), task.kind, tuple(worker), *needs)
        which = {doing[task.folder]: task for task in tasks}
        waiting = list(which)
        while waiting:
            (ended,), waiting = ray.wait(waiting, num_returns=1)
            task = which[ended]
            try:
                ray.get(ended)
            except ray.exceptions.RayError as error:
                cause = error.cause if isinstance(error, ray.exceptions.RayTaskError) else error
                if not isinstance(cause, ray.exceptions.RayError):  # not the worker's: a full disk, a bug
                    raise cause from error
                give_up(task.folder, task.kind, f"its Ray worker died too often: {type(cause).__name__}")
            yield task
    finally:
        ray.shutdown()


def _after(folder: str, kind: str, worker: tuple[str, ...], *_: None) -> None:
    """`carry_out`, when the tasks that the last arguments stand for have ended."""
    carry_out(Path(folder), kind, worker)
