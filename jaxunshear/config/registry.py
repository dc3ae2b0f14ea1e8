"""The networks that an experiment can train, in one table that all other modules read.

An experiment file can add one of its own, see docs/extending.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

from jaxunshear.config.losses import InputKind, Role
from jaxunshear.errors import UserError

ENTANGLED: Final = "entangled"
DISENTANGLED: Final = "disentangled"
POSENET: Final = "posenet"
ENTANGLED_LARGE: Final = "entangled_large"  # with as many parameters as the disentangled one
UNET: Final = "unet"
POSENET_SHEARED: Final = "posenet_sheared"  # PoseNet on slides
# PoseNet of the losses pose_label and pose_tap: trained first, from another seed, never evaluated
TEACHER: Final = "posenet_teacher"
# pose to tap, trained on recorded taps: draws the partners of recorded slides
RENDERER: Final = "renderer"

PIN_CONSTANTS = ("rest", "spread", "grid")  # variables of networks over pins that are not trained


@dataclass(frozen=True)
class NetworkSpec:
    """What a network does, what it learns from, and which settings it has."""

    name: str
    role: Role
    learns_from: Literal["pairs", "taps", "slides"]
    title: str = ""  # of its images in tables and figures
    modalities: tuple[InputKind, ...] = ("images", "pins")  # that it may read
    # the parts that are in released weights, () for all of it; None: it is not released
    released_parts: tuple[str, ...] | None = None
    # of a network that an experiment file has registered: its settings, and that file
    make_settings: Callable[..., object] | None = None
    file: str = ""


REGISTRY = {
    spec.name: spec
    for spec in (
        NetworkSpec(RENDERER, "renders", "taps"),
        NetworkSpec(TEACHER, "reads poses", "taps"),
        NetworkSpec(
            ENTANGLED,
            "unshears",
            "pairs",
            "entangled",
            released_parts=("E", "DC", *PIN_CONSTANTS),
        ),
        NetworkSpec(
            DISENTANGLED,
            "unshears",
            "pairs",
            "disentangled",
            released_parts=("E", "pose", "DC", *PIN_CONSTANTS),
        ),
        NetworkSpec(POSENET, "reads poses", "taps", released_parts=()),
        NetworkSpec(
            ENTANGLED_LARGE,
            "unshears",
            "pairs",
            "entangled, as many parameters",
            modalities=("images",),
        ),
        NetworkSpec(UNET, "unshears", "pairs", "U-Net", modalities=("images",)),
        NetworkSpec(POSENET_SHEARED, "reads poses", "slides", released_parts=()),
    )
}
TRAINABLE = REGISTRY.keys()  # with those that are registered later
NETWORKS: tuple[str, ...] = (ENTANGLED, DISENTANGLED, POSENET)  # the paper's
ALL_NETWORKS: tuple[str, ...] = (*NETWORKS, ENTANGLED_LARGE, UNET, POSENET_SHEARED)  # with rivals
# with those that are registered later; the main network of a run is the last of these that it has
UNSHEARING = [ENTANGLED, ENTANGLED_LARGE, UNET, DISENTANGLED]
POSENETS = tuple(name for name, spec in REGISTRY.items() if spec.role == "reads poses")


def add_network(spec: NetworkSpec) -> None:
    """Add a network that unshears. Raises UserError if another one has its name."""
    registered = REGISTRY.get(spec.name)
    if registered is None:
        UNSHEARING.insert(0, spec.name)
    elif registered.file != spec.file:  # else the file is read twice
        raise UserError(f"network '{spec.name}' is there already: choose another name")
    REGISTRY[spec.name] = spec


def list_networks() -> tuple[str, ...]:
    """List the networks that an experiment can name, with registered ones."""
    return tuple(name for name in REGISTRY if name not in (RENDERER, TEACHER))


def list_modality_networks(modality: InputKind) -> list[str]:
    """List the networks that may read inputs of a modality."""
    return [name for name in list_networks() if modality in REGISTRY[name].modalities]
