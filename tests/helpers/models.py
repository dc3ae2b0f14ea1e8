"""Runs on disk whose networks have learnt nothing."""

import json
from functools import partial

import jax
import numpy as np

from jaxunshear.config import networks
from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.sensor import TACTIP_127, Preprocess
from jaxunshear.config.serialization import to_json
from jaxunshear.config.targets import count_outputs
from jaxunshear.config.targets import to_json as targets_to_json
from jaxunshear.files import write_json
from jaxunshear.models import pin_networks, posenet, unshearnet
from jaxunshear.training import checkpoint
from jaxunshear.training.trainer import get_compile_options

KINDS = {
    networks.UnshearNet: "unshear",
    networks.PoseNet: "posenet",
    networks.PinUnshear: "pin_unshear",
    networks.PinPoseNet: "pin_posenet",
}


def init(net, seed, targets=(), rest=None, spread=1.0):
    """Draw variables; networks over pins need their rest positions (P, 2) px."""
    outputs = count_outputs(targets) if targets else 0
    if rest is not None:
        fresh = partial(pin_networks.init, net, rest, spread, outputs=outputs)
    elif isinstance(net, networks.PoseNet):
        fresh = partial(posenet.init, net, outputs)
    else:
        fresh = partial(unshearnet.init, net)
    return jax.jit(fresh, compiler_options=get_compile_options())(jax.random.key(seed))


def change_weights(variables, change):
    """Return variables whose trained arrays are changed, as initial ones hardly use the input."""
    return variables | {"params": jax.tree.map(change, variables["params"])}


def write_network(folder, net, variables, targets=()):
    kept = {"kind": KINDS[type(net)], "net": vars(net), "targets": targets_to_json(targets)}
    checkpoint.write_settings(folder, json.loads(json.dumps(kept)))
    checkpoint.save(folder, 1, {"average": variables}, {"history": [], "best_step": 1})
    write_json(folder / checkpoint.SUMMARY, {"steps": 1})


def write_run(folder, experiment, nets, variables, targets):
    """Write a run; nets and variables are by name, targets those of its PoseNets."""
    write_json(folder / "experiment.json", to_json(experiment))
    for name, net in nets.items():
        learnt = targets if name.startswith("posenet") else ()
        write_network(folder / name, net, variables[name], learnt)
    return folder


def write_pin_weights(folder, targets, rest, size):
    """Write random networks over 127 simulated pins: their answer depends on the pins alone."""
    seen = Preprocess(size=size)
    experiment = Experiment(
        *("skin", "none"),
        sensor=TACTIP_127,
        targets=tuple(target.name for target in targets),
        unshear=networks.UnshearNet(size=size, input="pins"),
        paired=PairedData(preprocess=seen),
        pose=PoseData(preprocess=seen),
    )
    nets = {"disentangled": networks.PinUnshear(hidden=16, layers=1)}
    nets["posenet"] = networks.PinPoseNet(hidden=16, layers=1)
    rng, variables = np.random.default_rng(1), {}
    for seed, (name, net) in enumerate(nets.items()):
        fresh = init(net, seed, targets if name == "posenet" else (), rest)
        variables[name] = change_weights(
            fresh, lambda x: x + rng.normal(0, 0.2, x.shape).astype(x.dtype)
        )
    return write_run(folder, experiment, nets, variables, targets)
