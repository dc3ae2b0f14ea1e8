"""What an experiment file holds: one frozen dataclass for the whole way of the data. Imports no JAX."""

from dataclasses import dataclass, field

from jaxunshear.dataset.settings import PairedData, PoseData
from jaxunshear.model.settings import PoseNet, UnshearNet
from jaxunshear.scene.sensor import TACTIP_331, Sensor
from jaxunshear.training.settings import Training


@dataclass(frozen=True)
class Experiment:
    """One run: `jaxunshear run FILE` reads the variable `experiment` of FILE. Results go to runs/<name>/."""

    name: str
    claim: str
    seed: int = 0
    sensor: Sensor = TACTIP_331
    paired: PairedData = field(default_factory=PairedData)
    pose: PoseData = field(default_factory=PoseData)
    unshear: UnshearNet = field(default_factory=UnshearNet)
    posenet: PoseNet = field(default_factory=PoseNet)
    train: Training = field(default_factory=Training)  # both UnshearNets
    train_posenet: Training = field(default_factory=Training)
