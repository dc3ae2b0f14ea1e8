"""Calls done here, one after the other, or spread over a Ray cluster: its workers may die and its nodes be lost. Imports neither Ray
nor JAX.

>>> for name, made in make_ray_runner("10.0.0.1:6379", 2)([Call(a, work, (1,)), Call(b, work, (2,), needs=(a,))]):
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
MAX_WAITING = 1000  # calls that wait at the cluster: enough for its workers, little memory however many calls there are


class Call(NamedTuple):
    """A function of a module that the workers can import, and its arguments."""

    name: Path  # where its outcome belongs
    function: Callable[..., object]
    arguments: tuple[object, ...]
    needs: tuple[Path, ...] = ()  # names of earlier calls that end before this one starts


class WorkerDied(NamedTuple):
    """In the place of what a call returns: each of its workers died."""

    reason: str


FinishedCall = tuple[Path, Any]  # the name of a call, and what it returned
CallRunner = Callable[[Iterable[Call]], Iterator[FinishedCall]]


def run_locally(calls: Iterable[Call]) -> Iterator[FinishedCall]:
    """In this process, in their order: the name of each and what it returned."""
    for call in calls:
        yield call.name, call.function(*call.arguments)


def make_ray_runner(address: str | None, cores_per_call: int) -> CallRunner:
    """The same as they end, on the cluster at `address`, or on one made on this machine; `cores_per_call` takes so many cores.

    Where the cluster has GPUs, a call gets one. An error that a call raises is raised here.
    Raises `UserError` at once where Ray is missing or nothing listens at the address.
    """
    if importlib.util.find_spec("ray") is None:
        raise UserError("--engine ray needs Ray: pip install -c constraints.txt '.[ray]'")
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon:  # else None, or "auto": Ray searches for a cluster on this machine
        try:
            socket.create_connection(
                (host, int(port)), timeout=10
            ).close()  # Ray itself would try for minutes
        except (OSError, ValueError) as error:
            raise UserError(
                f"--ray-address {address}: no cluster answers there ({error})"
            ) from error
    return functools.partial(_over_ray, address, cores_per_call)


def _over_ray(address: str | None, each: int, calls: Iterable[Call]) -> Iterator[FinishedCall]:
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
        remote = ray.remote(num_cpus=min(each, largest), num_gpus=gpus, max_retries=RETRIES)(_after)
        doing: dict[Path, ray.ObjectRef] = {}
        while following or doing:
            while following and len(doing) < MAX_WAITING:
                needs = [doing[name] for name in following.needs if name in doing]
                work = ray.cloudpickle.dumps((following.function, following.arguments))
                doing[following.name] = remote.remote(work, *needs)
                following = next(calls, None)
            (ended,), _ = ray.wait(list(doing.values()), num_returns=1)
            name = next(name for name, reference in doing.items() if reference == ended)
            del doing[name]
            yield name, _fetch_result(ended)
    finally:
        ray.shutdown()


def _connect(address: str | None) -> None:
    """Raises `UserError`."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # says nothing to anyone unless asked to
    os.environ.setdefault("RAY_task_oom_retries", str(RETRIES))  # else without end
    import ray

    # Ray would give BLAS as many threads as a call has cores, and the order of its sums goes by their number
    threads = os.environ.get("OMP_NUM_THREADS") or str(count_cores())
    try:
        # it starts processes, after JAX threads
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
            ray.init(
                address=address or "local",
                include_dashboard=False if address is None else None,
                log_to_driver=False,
                logging_level=logging.ERROR,
                runtime_env={"env_vars": {"OMP_NUM_THREADS": threads}},
            )
    except Exception as error:
        said = " ".join(str(error).split())
        raise UserError(
            f"--ray-address {address or 'local'}: Ray cannot be reached ({said})"
        ) from error


def _fetch_result(reference: "ray.ObjectRef[object]") -> object:
    """What a call returned, or `WorkerDied`. Raises what the call raised."""
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        cause = error.cause if isinstance(error, ray.exceptions.RayTaskError) else error
        if not isinstance(cause, ray.exceptions.RayError):  # not the worker's: a full disk, a bug
            raise cause from error
        return WorkerDied(f"its Ray worker died too often: {type(cause).__name__}")


def _after(work: bytes, *_: object) -> object:
    """A pickled call, when those that the last arguments stand for have ended."""
    check_variables()  # a worker's machine has its own
    function, arguments = pickle.loads(work)
    return function(*arguments)
