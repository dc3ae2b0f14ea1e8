"""The networks that an experiment can train: one table, which all that treats them apart asks.

A network of another name needs an entry here, the settings that build it in `training/task_factory.py`, and a colour in `style.py`.
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
# the PoseNet of the losses pose_label and pose_tap: trained first, from another seed, and never evaluated
TEACHER: Final = "posenet_teacher"
RENDERER: Final = (
    "renderer"  # pose to tap, learnt from recorded taps: draws the partners of recorded slides
)

PIN_CONSTANTS = ("rest", "spread", "grid")  # variables of networks over pins that are not trained


@dataclass(frozen=True)
class NetworkSpec:
    """What a network does, and what that takes."""

    name: str
    role: Literal["unshears", "reads poses", "renders"]
    learns_from: Literal["pairs", "taps", "slides"]
    # groups of an experiment that its training over images does not read
    unused_groups: tuple[str, ...]
    title: str = ""  # of its images in tables and figures
    has_codes: bool = False  # it depends on how many numbers the codes have
    supports_pins: bool = True  # whether it may read pins in the place of images
    # the parts that go with released weights, () for all of it; None: it stays
    released_parts: tuple[str, ...] | None = None


_UNSHEARS = ("pose", "posenet", "train_posenet", "train_teacher")
REGISTRY = {
    kind.name: kind
    for kind in (
        NetworkSpec(RENDERER, "renders", "taps", _UNSHEARS),
        NetworkSpec(
            TEACHER, "reads poses", "taps", ("paired", "unshear", "train", "train_posenet")
        ),
        NetworkSpec(
            ENTANGLED,
            "unshears",
            "pairs",
            _UNSHEARS,
            "entangled",
            released_parts=("E", "DC", *PIN_CONSTANTS),
        ),
        NetworkSpec(
            DISENTANGLED,
            "unshears",
            "pairs",
            _UNSHEARS,
            "disentangled",
            has_codes=True,
            released_parts=("E", "pose", "DC", *PIN_CONSTANTS),
        ),
        NetworkSpec(
            POSENET,
            "reads poses",
            "taps",
            ("paired", "unshear", "train", "train_teacher"),
            released_parts=(),
        ),
        NetworkSpec(
            ENTANGLED_LARGE,
            "unshears",
            "pairs",
            _UNSHEARS,
            "entangled, as many parameters",
            has_codes=True,
            supports_pins=False,
        ),
        NetworkSpec(UNET, "unshears", "pairs", _UNSHEARS, "U-Net", supports_pins=False),
        NetworkSpec(
            POSENET_SHEARED,
            "reads poses",
            "slides",
            ("pose", "unshear", "train", "train_teacher"),
            released_parts=(),
        ),
    )
}
TRAINABLE = tuple(REGISTRY)
NETWORKS: tuple[Network, ...] = (ENTANGLED, DISENTANGLED, POSENET)  # the paper's
ALL_NETWORKS: tuple[Network, ...] = (
    *NETWORKS,
    ENTANGLED_LARGE,
    UNET,
    POSENET_SHEARED,
)  # and rivals
UNSHEARING = (
    ENTANGLED,
    ENTANGLED_LARGE,
    UNET,
    DISENTANGLED,
)  # the last that a run has is the one it is about
POSENETS = tuple(name for name, kind in REGISTRY.items() if kind.role == "reads poses")
TAP_NETWORKS = tuple(name for name, kind in REGISTRY.items() if kind.learns_from == "taps")
PIN_NETWORKS = tuple(name for name in ALL_NETWORKS if REGISTRY[name].supports_pins)
