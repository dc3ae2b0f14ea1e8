"""Measure how long each network takes for one sheared input at a time, as a robot would ask."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jax import Array

from jaxunshear.config.registry import POSENETS
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.registry import get_net_modality, predict, unshear
from jaxunshear.training.checkpoint import load_best, read_net

CALLS = 40
WARM_UP_CALLS = 3  # not counted: the first compiles


def measure_ms_per_image(run_dir: Path, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Measure `median` and `p95` ms, host to host, of each network in `run_dir`."""
    times = {}
    for name in names:
        net = read_net(Path(run_dir) / name)
        variables = load_best(Path(run_dir) / name)
        run = jit_for_inference(partial(predict if name in POSENETS else unshear, net), variables)
        times[name] = _time_calls(run, get_net_modality(net).make_example(net, variables))
    return times


def _time_calls(run: Callable[[np.ndarray], Array], example: np.ndarray) -> dict[str, float]:
    """Time calls with one example, in ms."""
    times_ms = []
    for _ in range(WARM_UP_CALLS + CALLS):
        started = time.perf_counter()
        np.asarray(run(example))
        times_ms.append(1e3 * (time.perf_counter() - started))
    counted = times_ms[WARM_UP_CALLS:]
    return {"median": float(np.median(counted)), "p95": float(np.percentile(counted, 95))}
