"""A stand-in for Ray, which few machines have."""

import pickle
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


class RayError(Exception):
    cause: Exception | None = None


def make_ray(died: bool) -> Any:
    """Make a stand-in for Ray with one node, which does each call as it is asked for."""
    ray: Any = ModuleType("ray")
    ray.__spec__ = ModuleSpec("ray", None)
    ray.exceptions = ModuleType("exceptions")
    ray.exceptions.RayError = RayError
    ray.exceptions.RayTaskError = type("RayTaskError", (RayError,), {})
    ray.cloudpickle = pickle
    ray.init = ray.shutdown = lambda **_: None
    ray.nodes = lambda: [{"Alive": True, "Resources": {"CPU": 2.0}}]
    ray.wait = lambda running, num_returns: (running[:1], running[1:])

    def make_remote(function):
        remote = ModuleType("remote")
        remote.remote = lambda *given: [function, given]  # type: ignore[attr-defined]
        return remote

    def get(reference):
        if died:
            raise RayError
        function, given = reference
        return function(*given)

    ray.remote, ray.get = lambda **_: make_remote, get
    return ray
