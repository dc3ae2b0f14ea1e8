"""Runs networks over images by onnxruntime, frame by frame. Needs the extra `onnx`.

XLA computes most convolutions of a small image in one thread, onnxruntime in all.

>>> model.compile_networks = compile_for_frames
"""

from collections.abc import Mapping

import jax
import numpy as np

from jaxunshear.apps.export import networks as onnx_networks
from jaxunshear.apps.export.onnx_file import open_session
from jaxunshear.apps.export.onnx_graph import FLOAT, OnnxGraph
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.targets import list_target_names
from jaxunshear.inference.forward import (
    RunNetwork,
    RunNetworks,
    chain_networks,
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
    runs = {name: _open_network(network) for name, network in networks.items()}
    return chain_networks(runs, with_sheared_poses)


def _open_network(network: TrainedNetwork) -> RunNetwork:
    """Make a function of scaled images, by onnxruntime."""
    net, variables, targets = network
    graph, is_unshearing = OnnxGraph(), type(net) is UnshearNet
    outputs = onnx_networks.add_network(graph, net, variables, INPUT)
    if not is_unshearing:
        outputs = onnx_networks.add_pose(graph, targets, outputs)
    image = ("batch", 1, net.size, net.size)
    graph.add_output("outputs", outputs, image if is_unshearing else ("batch", len(targets)))
    session = open_session(graph.build(INPUT, image, FLOAT, {}).SerializeToString())

    def run(values: np.ndarray) -> np.ndarray | dict[str, np.ndarray]:
        images = values.reshape(-1, 1, net.size, net.size)
        (outputs,) = session.run(None, {INPUT: images})
        if is_unshearing:
            return outputs.reshape(values.shape)
        return dict(zip(list_target_names(targets), outputs.T, strict=True))

    return run


def _has_onnx_form(net: Net) -> bool:
    is_unshearnet = type(net) is UnshearNet and not net.separate_encoders
    return is_unshearnet or type(net) is PoseNet
