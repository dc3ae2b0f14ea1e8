"""Runs networks over images by onnxruntime, frame by frame. Needs the extra `onnx`.

XLA computes most convolutions of a small image in one thread, onnxruntime in all.

>>> model.compile_networks = compile_for_frames
"""

from collections.abc import Mapping

import jax
import numpy as np
import onnxruntime

from jaxunshear.apps.export import networks as onnx_networks
from jaxunshear.apps.export.onnx_graph import FLOAT, OnnxGraph
from jaxunshear.config.networks import DISENTANGLED, POSENET, POSENET_SHEARED, PoseNet, UnshearNet
from jaxunshear.config.targets import list_target_names
from jaxunshear.inference.forward import (
    AS_RECORDED,
    LEARNT,
    UNSHEARED,
    RunNetworks,
    compile_networks,
)
from jaxunshear.models.weights import Net
from jaxunshear.training.checkpoint import TrainedNetwork

INPUT = "image"


def compile_for_frames(
    networks: Mapping[str, TrainedNetwork], with_sheared_poses: bool
) -> RunNetworks:
    """Do as `compile_networks`, by onnxruntime if JAX is on a CPU and all networks take images."""
    suited = all(_has_onnx_form(network.net) for network in networks.values())
    if not suited or jax.default_backend() != "cpu":
        return compile_networks(networks, with_sheared_poses)
    graph, unsheared = OnnxGraph(), ""
    size = next(iter(networks.values())).net.size
    kinds = {AS_RECORDED: (POSENET, INPUT), LEARNT: (POSENET_SHEARED, INPUT)}
    if DISENTANGLED in networks:
        net, variables, _ = networks[DISENTANGLED]
        unsheared = onnx_networks.add_network(graph, net, variables, INPUT)
        graph.add_output(UNSHEARED + INPUT, unsheared, ("batch", 1, size, size))
        kinds |= {UNSHEARED: (POSENET, unsheared)}
        if not with_sheared_poses:
            del kinds[AS_RECORDED]
    kinds = {kind: kinds[kind] for kind in kinds if kinds[kind][0] in networks}
    for kind, (name, inputs) in kinds.items():
        net, variables, targets = networks[name]
        outputs = onnx_networks.add_network(graph, net, variables, inputs)
        pose = onnx_networks.add_pose(graph, targets, outputs)
        graph.add_output(kind, pose, ("batch", len(targets)))
    model = graph.build(INPUT, ("batch", 1, size, size), FLOAT, {}).SerializeToString()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors alone
    # threads that wait for work in a loop take cores from a camera's driver
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]

    def run(values: np.ndarray) -> tuple[np.ndarray | None, dict[str, dict[str, np.ndarray]]]:
        images = values.reshape(-1, 1, size, size)
        outputs = dict(zip(names, session.run(None, {INPUT: images}), strict=True))
        image = outputs[UNSHEARED + INPUT].reshape(values.shape) if unsheared else None
        poses = {
            kind: dict(zip(list_target_names(networks[name].targets), outputs[kind].T, strict=True))
            for kind, (name, _) in kinds.items()
        }
        return image, poses

    return run


def _has_onnx_form(net: Net) -> bool:
    is_unshearnet = type(net) is UnshearNet and not net.separate_encoders
    return is_unshearnet or type(net) is PoseNet
