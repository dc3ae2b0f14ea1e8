"""How long a robot waits for an image: each network that takes sheared ones, by itself, one image at a time."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array

from jaxunshear.config.networks import PinNet, PinUnshear
from jaxunshear.config.registry import POSENETS
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.dispatch import unshear
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training.checkpoint import load_best, read_net

CALLS = 40


def measure_ms_per_image(run_dir: Path, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """`median` and `p95` of milliseconds from a host's image to a host's answer, of each network in `run_dir`; compilation apart."""
    found = {}
    for name in names:
        net = read_net(Path(run_dir) / name)
        answer = make_inference_function(name, net)
        variables = load_best(Path(run_dir) / name)
        found[name] = time_calls(jit_for_inference(answer, variables), _make_input(net, variables))
    return found


def make_inference_function(name: str, net: Net) -> Callable[[Variables, Array], Array]:
    """The network called `name` as (variables, images) -> its answer: images (B, S, S, 1) in [0, 1] unsheared, or PoseNet's
    outputs (B, K). Networks over pins take these, (B, P, 2) px, in the place of images."""
    if isinstance(net, PinNet):
        read: Any = pin_networks.unshear if isinstance(net, PinUnshear) else pin_networks.predict
        return lambda variables, pins: read(net, variables, pins)
    answer: Any = posenet.predict if name in POSENETS else unshear
    return lambda variables, images: answer(net, variables, images)


def _make_input(net: Net, variables: Variables) -> np.ndarray:
    """One image (1, S, S, 1) of random dots, or the untouched pins (1, P, 2)."""
    if isinstance(net, PinNet):
        return np.asarray(variables["batch_stats"]["rest"])[None]
    return (np.random.default_rng(0).random((1, net.size, net.size, 1)) < 0.2).astype(np.float32)


def time_calls(run: Callable[[np.ndarray], Array], image: np.ndarray) -> dict[str, float]:
    """Milliseconds of one call with one image (1, S, S, 1) float32, or one contact's pins."""
    spent = []
    for _ in range(CALLS + 3):  # the first compile and warm up
        started = time.perf_counter()
        np.asarray(run(image))
        spent.append(1e3 * (time.perf_counter() - started))
    return {"median": float(np.median(spent[3:])), "p95": float(np.percentile(spent[3:], 95))}
