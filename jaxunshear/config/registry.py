"""The networks that an experiment can train, in one table that all other modules read.

CONTRIBUTING.md lists the files that a new network touches.
"""

from dataclasses import dataclass
from typing import Final, Literal

Network = Literal[
    "entangled", "disentangled", "posenet", "entangled_large", "unet", "posenet_sheared"
]
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
    role: Literal["unshears", "reads poses", "renders"]
    learns_from: Literal["pairs", "taps", "slides"]
    title: str = ""  # of its images in tables and figures
    has_codes: bool = False  # whether it depends on the sizes of the codes
    supports_pins: bool = True  # whether it may read pins instead of images
    # the parts that are in released weights, () for all of it; None: it is not released
    released_parts: tuple[str, ...] | None = None


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
            has_codes=True,
            released_parts=("E", "pose", "DC", *PIN_CONSTANTS),
        ),
        NetworkSpec(POSENET, "reads poses", "taps", released_parts=()),
        NetworkSpec(
            ENTANGLED_LARGE,
            "unshears",
            "pairs",
            "entangled, as many parameters",
            has_codes=True,
            supports_pins=False,
        ),
        NetworkSpec(UNET, "unshears", "pairs", "U-Net", supports_pins=False),
        NetworkSpec(POSENET_SHEARED, "reads poses", "slides", released_parts=()),
    )
}
TRAINABLE = tuple(REGISTRY)
NETWORKS: tuple[Network, ...] = (ENTANGLED, DISENTANGLED, POSENET)  # the paper's
# with rivals
ALL_NETWORKS: tuple[Network, ...] = (*NETWORKS, ENTANGLED_LARGE, UNET, POSENET_SHEARED)
# the main network of a run is the last of these that it has
UNSHEARING = (ENTANGLED, ENTANGLED_LARGE, UNET, DISENTANGLED)
POSENETS = tuple(name for name, spec in REGISTRY.items() if spec.role == "reads poses")
TAP_NETWORKS = tuple(name for name, spec in REGISTRY.items() if spec.learns_from == "taps")
PIN_NETWORKS = tuple(name for name in ALL_NETWORKS if REGISTRY[name].supports_pins)
