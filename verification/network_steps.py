"""Training steps without their loop, so that a network is compiled once for many cases.

    output = run_steps(net, training, make, folder)  # some steps, each inspected, saved, and used

Steps, inspections and checkpoints are the loop's own; learning rate and patch weight are arguments
of the compiled step.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PoseNet, UNet, UnshearNet
from jaxunshear.config.targets import make_range_targets
from jaxunshear.config.training import Training, drop_pair_losses
from jaxunshear.files import Json
from jaxunshear.models import posenet, unshearnet
from jaxunshear.models.registry import unshear
from jaxunshear.models.weights import Variables
from jaxunshear.training import checkpoint
from jaxunshear.training.monitor import check_state, check_terms
from jaxunshear.training.step import State, make_optimiser, make_step
from jaxunshear.training.tasks import Task, make_posenet_task, make_unshear_task
from jaxunshear.training.trainer import jit_first_state
from verification.network_images import Batch
from verification.stability_networks import CaseOutput

STEPS, SAVED_EVERY = 8, 4
TARGETS = make_range_targets((), Ranges())
Net = UnshearNet | UNet | PoseNet
Guards = tuple[Callable[..., dict[str, float]], Callable[..., None]]


class Programs(NamedTuple):
    """The compiled programs of one network."""

    state: State  # the first one
    # state, batch, learning rate, patch weight -> state, terms
    step: Callable[..., tuple[State, dict[str, jax.Array]]]
    infer: Callable[..., dict[str, jax.Array]]  # as `infer_all`


def make_task(net: Net, training: Training) -> Task:
    if isinstance(net, PoseNet):
        return make_posenet_task(net, drop_pair_losses(training, pose=1.0), TARGETS)
    return make_unshear_task(net, training)


def build_programs(net: Net, training: Training) -> Programs:
    """Build the programs of `net`.

    Trainings that differ only in learning rate and (positive) patch weight share them. Raises
    `UserError`.
    """
    same: Json = {
        "learning_rate": 1.0,
        "losses": {**training.losses, "patch": float("patch" in training.losses)},
        "drops": ((1.0, 1.0),),  # a rate that stays
    }
    return _compile(net, replace(training, **same))


@functools.cache
def _compile(net: Net, training: Training) -> Programs:
    task = make_task(net, training)

    def step(
        state: State, batch: Batch, rate: float, weight: float
    ) -> tuple[State, dict[str, jax.Array]]:
        weighed = replace(task, weights=task.weights | {"patch": weight})
        optimiser = make_optimiser(replace(training, learning_rate=rate), STEPS, 1)
        return make_step(weighed, training, optimiser, jax.random.key(1))(state, batch)

    optimiser = make_optimiser(training, STEPS, 1)
    infer_ = jax.jit(lambda variables, images: infer_all(net, variables, images))
    return Programs(jit_first_state(task, optimiser)(jax.random.key(0)), jax.jit(step), infer_)


def run_steps(
    net: Net,
    training: Training,
    make: Callable[[int], Batch],
    folder: Path,
    steps: int = STEPS,
    guards: Guards = (check_terms, check_state),
) -> CaseOutput:
    """Run training steps of float batches `make(step)`, then infer from `make(-1)`.

    Inference uses the network that was kept. The learning rate stays, and is that of `training` or
    of its last drop. Raises `UserError` where the loop would, by `guards` of each step's terms and
    of a state to be saved.
    """
    state, step, infer = build_programs(net, training)
    drops = dict(training.drops)
    for done in range(1, steps + 1):
        batch = make(done - 1)
        rate = training.learning_rate * drops.get(done - 1, 1.0)
        state, terms = step(
            state, batch, np.float32(rate), np.float32(training.losses.get("patch", 0.0))
        )
        last = guards[0](done, terms, batch, folder)
        if done % SAVED_EVERY == 0:
            guards[1](state, done, batch, folder)
            checkpoint.save(folder, done, state, {"best_step": done, "history": []})
    variables = checkpoint.load_best(folder)
    outputs = dict(infer(variables, get_images(make(-1))))
    arrays = {"terms": last, "variables": variables, "outputs": outputs}
    return describe_training(net, arrays, variables, steps, last)


def describe_training(
    net: Net, arrays: Json, variables: Variables, steps: int, last: dict[str, float]
) -> CaseOutput:
    """Make the output of a case from the `last` terms and the variables of a training."""
    loss, gradient = last[get_loss_name(net)], last["gradient"]
    note = "" if gradient else "the gradient is 0: all is saturated, and nothing more is learnt"
    if last["regularisation"] > loss:
        ratio = last["regularisation"] / loss
        note = f"l1 and l2 weigh {ratio:.2g} times the loss: kernels shrink first"
    wrong = _check_parts(net, variables)
    return CaseOutput(arrays, wrong=wrong, note=note, steps=steps, loss=loss, gradient=gradient)


def get_loss_name(net: Net) -> str:
    return "pose" if isinstance(net, PoseNet) else "supervised"


def get_images(batch: Batch) -> np.ndarray:
    """Return a network's input images: taps for PoseNet, sheared images for the others."""
    return batch["image" if "image" in batch else "sheared"]


def infer_all(net: Net, variables: Variables, images: jax.Array) -> dict[str, jax.Array]:
    """Infer all that the network can from images (B, S, S, 1) in [0, 1], each (B, ...)."""
    if isinstance(net, PoseNet):
        scaled = posenet.predict(net, variables, images)
        return {"outputs": scaled, **posenet.unscale_outputs(scaled, TARGETS)}
    if isinstance(net, UNet):
        return {"unsheared": unshear(net, variables, images)}
    z_p, z_s = unshearnet.encode(net, variables, images)
    unsheared = jax.nn.sigmoid(unshearnet.decode_canonical(net, variables, z_p))
    outputs = {"unsheared": unsheared, "z_p": z_p}
    if z_s is not None:
        sheared = jax.nn.sigmoid(unshearnet.decode_sheared(net, variables, z_p, z_s))
        outputs |= {"z_s": z_s, "sheared": sheared}
    return outputs


def _check_parts(net: Net, variables: Variables) -> str:
    """Describe how the parts of a network differ from those of its settings, if they do."""
    if not isinstance(net, UnshearNet):
        return ""
    expected = {"E", "DC"}
    if net.disentangled:
        expected |= {"pose"} | ({"shear", "DS"} if net.shear_channels else set())
    built = set(variables["params"])
    return "" if built == expected else f"built {sorted(built)}, not {sorted(expected)}"
