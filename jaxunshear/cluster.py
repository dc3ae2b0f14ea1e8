"""Runs calls here, one after the other, or over a Ray cluster. Imports neither Ray nor JAX.

The workers of a cluster may die and its nodes be lost.

>>> run_calls = make_ray_runner("10.0.0.1:6379", 2)
>>> for name, outcome in run_calls([Call(a, work, (1,)), Call(b, work, (2,), needs=(a,))]):
...     ...  # what `work` returned, or `WorkerDied`
"""

import functools
import importlib.util
import logging
import os
import pickle
import socket
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxunshear.environment import check_variables, count_cores
from jaxunshear.errors import UserError

if TYPE_CHECKING:
    import ray

RETRIES = 5  # of a call whose worker died
MAX_WAITING = 1000  # calls at the cluster: enough for its workers, in little memory


class Call(NamedTuple):
    """A function of a module that workers can import, and its arguments."""

    name: Path  # where its outcome belongs
    function: Callable[..., object]
    arguments: tuple[object, ...]
    needs: tuple[Path, ...] = ()  # names of earlier calls that end before this one starts


class WorkerDied(NamedTuple):
    """The outcome of a call whose workers all died."""

    reason: str


FinishedCall = tuple[Path, Any]  # the name of a call, and what it returned
CallRunner = Callable[[Iterable[Call]], Iterator[FinishedCall]]


def run_locally(calls: Iterable[Call]) -> Iterator[FinishedCall]:
    """Run calls in this process, in their order; yield the name of each and what it returned."""
    for call in calls:
        yield call.name, call.function(*call.arguments)


def make_ray_runner(address: str | None, cores_per_call: int) -> CallRunner:
    """Make a runner that yields calls as they end, on a cluster or on one made on this machine.

    Each call takes `cores_per_call` cores, and a GPU if the cluster has any. The runner raises an
    error that a call raises. Raises UserError if Ray is missing or nothing listens at `address`.
    """
    if importlib.util.find_spec("ray") is None:
        raise UserError("--engine ray needs Ray: pip install -c constraints.txt '.[ray]'")
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon:  # else None, or "auto": Ray searches for a cluster on this machine
        try:
            # Ray itself would try for minutes
            socket.create_connection((host, int(port)), timeout=10).close()
        except (OSError, ValueError) as error:
            raise UserError(
                f"--ray-address {address}: no cluster answers there ({error})"
            ) from error
    return functools.partial(_run_on_ray, address, cores_per_call)


def _run_on_ray(
    address: str | None, cores_per_call: int, calls: Iterable[Call]
) -> Iterator[FinishedCall]:
    calls = iter(calls)
    following = next(calls, None)
    if following is None:
        return
    _connect(address)
    import ray

    try:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        largest = max(node.get("CPU", 1) for node in nodes)
        gpus = 1 if any(node.get("GPU", 0) >= 1 for node in nodes) else 0
        cores = min(cores_per_call, largest)
        remote = ray.remote(num_cpus=cores, num_gpus=gpus, max_retries=RETRIES)(_run_pickled)
        running: dict[Path, ray.ObjectRef] = {}
        while following or running:
            while following and len(running) < MAX_WAITING:
                needs = [running[name] for name in following.needs if name in running]
                work = ray.cloudpickle.dumps((following.function, following.arguments))
                running[following.name] = remote.remote(work, *needs)
                following = next(calls, None)
            (ended,), _ = ray.wait(list(running.values()), num_returns=1)
            name = next(name for name, reference in running.items() if reference == ended)
            del running[name]
            yield name, _fetch_result(ended)
    finally:
        ray.shutdown()


def _connect(address: str | None) -> None:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # says nothing to anyone unless asked to
    os.environ.setdefault("RAY_task_oom_retries", str(RETRIES))  # else without end
    import ray

    # Ray would give BLAS a thread per core of a call, and their number decides the order of sums
    threads = os.environ.get("OMP_NUM_THREADS") or str(count_cores())
    try:
        # Ray starts processes after JAX has started threads
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
            ray.init(
                address=address or "local",
                include_dashboard=False if address is None else None,
                log_to_driver=False,
                logging_level=logging.ERROR,
                runtime_env={"env_vars": {"OMP_NUM_THREADS": threads}},
            )
    except Exception as error:
        reason = " ".join(str(error).split())
        raise UserError(
            f"--ray-address {address or 'local'}: Ray cannot be reached ({reason})"
        ) from error


def _fetch_result(reference: "ray.ObjectRef[object]") -> object:
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        cause = error.cause if isinstance(error, ray.exceptions.RayTaskError) else error
        if not isinstance(cause, ray.exceptions.RayError):  # not the worker's: a full disk, a bug
            raise cause from error
        return WorkerDied(f"its Ray worker died too often: {type(cause).__name__}")


def _run_pickled(work: bytes, *_: object) -> object:
    """Run a pickled call; Ray waits for the calls that the other arguments stand for."""
    check_variables()  # a worker's machine has its own
    function, arguments = pickle.loads(work)
    return function(*arguments)
