"""The config of each network of a run, resolved from the experiment.

>>> config = resolve_network(experiment, "disentangled")
>>> config.training.losses, config.digest

A config holds all that decides the weights of a network, and nothing else: two experiments whose
configs are equal can share the training, as the rows of a sweep do. It is derived from an
experiment: `_list_helpers` lists the networks that it learns from, `select_for` of the source
selects its data, `_select_training` its losses and schedule, `_select_net` its size and parts.
"""

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import cast

from jaxunshear.config.configs import compute_digest
from jaxunshear.config.data import DataSettings, PoseData
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.losses import InputKind
from jaxunshear.config.networks import (
    DISENTANGLED,
    ENTANGLED,
    POSENET_SHEARED,
    REGISTRY,
    RENDERER,
    TEACHER,
    UNET,
    NetSettings,
    NetworkSpec,
    PinPoseNet,
    PinRenderer,
    PinUnshear,
    UNet,
    UnshearNet,
)
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.targets import list_column_names
from jaxunshear.config.training import Training, drop_pair_losses, uses_teacher
from jaxunshear.files import Json

TEACHER_SEED = 1000  # is added to the seed of the experiment
HELPERS = (RENDERER, TEACHER, POSENET_SHEARED)  # networks that others learn from, in their order


@dataclass(frozen=True)
class NetworkConfig:
    """All that decides the weights of one network; fields that it does not use are at defaults."""

    name: str
    modality: InputKind
    source: DataSettings  # the set that it learns from
    taps: PoseData | None  # simulated taps without slides that it learns from as well
    sensor: Sensor
    net: NetSettings
    training: Training
    targets: tuple[str, ...]
    seed: int
    randomised: float  # share of its batches whose pins are changed by domain randomisation
    needs: tuple["NetworkConfig", ...] = ()  # the networks that it learns from

    @property
    def spec(self) -> NetworkSpec:
        return REGISTRY[self.name]

    @cached_property
    def digest(self) -> str:
        """Eight hexadecimal digits: networks of one digest have equal trainings."""
        return compute_digest({"config": asdict(self), "data": self.source.version})


def resolve_network(experiment: Experiment, name: str) -> NetworkConfig:
    spec, pins = REGISTRY[name], uses_pins(experiment)
    training, simulated = _select_training(experiment, spec), experiment.paired.is_simulated
    learns_from_taps = "tap_identity" in training.losses and simulated
    return NetworkConfig(
        name=name,
        modality="pins" if pins or name == RENDERER else "images",
        source=experiment.paired.select_for(spec, experiment.pose),
        taps=cast(PoseData, experiment.pose) if learns_from_taps else None,
        sensor=experiment.sensor,
        net=_select_net(experiment, spec),
        training=training,
        targets=_select_targets(experiment, spec),
        seed=experiment.seed + (TEACHER_SEED if name == TEACHER else 0),
        randomised=experiment.pins.rotated_share if pins and simulated else 0.0,
        needs=tuple(resolve_network(experiment, need) for need in _list_helpers(experiment, spec)),
    )


def resolve_trained_networks(experiment: Experiment) -> list[NetworkConfig]:
    """Resolve the configs of all networks to train, in their order."""
    return [resolve_network(experiment, name) for name in list_trained_networks(experiment)]


def list_trained_networks(experiment: Experiment) -> tuple[str, ...]:
    """List the networks to train, in this order: `experiment.networks` after those they need."""
    configs = [resolve_network(experiment, name) for name in experiment.networks]
    return list_required_networks(*configs)


def list_required_networks(*configs: NetworkConfig) -> tuple[str, ...]:
    """List the networks that must be trained in a folder, in this order, to have these."""
    needed: set[str] = set()
    for config in configs:
        needed.update(list_required_networks(*config.needs))
    first = [name for name in HELPERS if name in needed]
    return tuple(dict.fromkeys([*first, *(config.name for config in configs)]))


def takes_taps(experiment: Experiment) -> bool:
    """Return whether a network of a simulated experiment learns from the taps of `pose`."""
    configs = resolve_trained_networks(experiment)
    return any(config.taps or config.source is experiment.pose for config in configs)


def _list_helpers(experiment: Experiment, spec: NetworkSpec) -> tuple[str, ...]:
    if experiment.paired.has_parts:
        return ()
    pins = uses_pins(experiment)
    training = experiment.train_pins if pins else experiment.train
    teacher = (TEACHER,) if spec.role == "unshears" and uses_teacher(training) else ()
    # a renderer knows the pins of poses alone: it gives no further examples of other columns
    adds_rendered = pins and not list_column_names(experiment.targets)
    return teacher + experiment.paired.list_helpers(spec, adds_rendered)


def _select_targets(experiment: Experiment, spec: NetworkSpec) -> tuple[str, ...]:
    if spec.role != "renders":
        return experiment.targets
    columns = list_column_names(experiment.targets)
    return tuple(text for text in experiment.targets if text.partition(":")[0] not in columns)


def _select_training(experiment: Experiment, spec: NetworkSpec) -> Training:
    pins = uses_pins(experiment)
    if spec.role == "unshears":
        training = experiment.train_pins if pins else experiment.train
        is_simulated = experiment.paired.is_simulated
        if not (pins and is_simulated):
            training = replace(training, paired_share=1.0)
        if pins and not is_simulated and getattr(experiment.paired, "pairing", "") != "simulated":
            return training
        return replace(training, rotated_below=0)
    if spec.role == "renders":
        return drop_pair_losses(experiment.train_pins, pins=1.0)
    if pins:
        rendered = {"rendered_pose": 1.0} if RENDERER in _list_helpers(experiment, spec) else {}
        return drop_pair_losses(experiment.train_pins, pose=1.0, **rendered)
    training = experiment.train_teacher if spec.name == TEACHER else experiment.train_posenet
    return drop_pair_losses(training, **training.losses)


def _select_net(experiment: Experiment, spec: NetworkSpec) -> NetSettings:
    """Select the settings of a network, derived from those that networks of its kind share."""
    if spec.make_settings is not None:
        return cast(NetSettings, spec.make_settings(experiment))
    if uses_pins(experiment) or spec.role == "renders":
        return _select_pin_net(experiment, spec)
    if spec.role == "reads poses":
        return experiment.posenet
    net = replace(experiment.unshear, disentangled=True)
    if spec.name == UNET:
        return UNet(net.size, net.widths)
    if spec.name == ENTANGLED:
        return UnshearNet(net.size, net.widths, disentangled=False)
    return net


def _select_pin_net(experiment: Experiment, spec: NetworkSpec) -> NetSettings:
    pins = experiment.pins
    if spec.role == "unshears":
        code = pins.shear_code if spec.name == DISENTANGLED else 0
        used = replace(pins, direct_conv_channels=(), rotated_share=0.0, shear_code=code)
        return PinUnshear(**asdict(used))
    settings: Json = {name: getattr(pins, name) for name in ("hidden", "layers", "noise_px")}
    if spec.role == "renders":
        return PinRenderer(**settings)
    if spec.learns_from == "slides":
        # simulated pins are turned by domain randomisation, without a network that knows of it
        turned = 0.0 if experiment.paired.is_simulated else pins.rotated_share
        settings |= {"rotated_share": turned, "conv_channels": pins.direct_conv_channels}
    return PinPoseNet(**settings)
