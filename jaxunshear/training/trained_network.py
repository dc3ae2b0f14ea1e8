"""A network of a finished training: settings, variables and targets."""

from pathlib import Path
from typing import NamedTuple

from jaxunshear.config.targets import Targets
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training.checkpoint import check_finished, load_best, read_net, read_targets


class TrainedNetwork(NamedTuple):
    net: Net
    variables: Variables
    targets: Targets  # that it predicts, of a PoseNet


def load_network(folder: Path) -> TrainedNetwork:
    """Load a network from its folder. Raises UserError if it is missing, damaged or unfinished."""
    check_finished(folder)
    return TrainedNetwork(read_net(folder), load_best(folder), read_targets(folder))
