"""The networks that an experiment can train, in one table, and the settings of each kind.

Other modules read the table. An experiment file can add a network, see docs/extending.md.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from jaxunshear.config.losses import IMAGES, InputKind, Role
from jaxunshear.config.types import Bound, Count, Counts, NotNegative, Problem, between

CodeSize = Annotated[
    int, Bound(lambda size: size >= 0, "must not be below zero; 0 builds no shear code")
]
GridChannels = Annotated[
    Counts,
    Bound(
        lambda channels: len(channels) <= 4,
        "list at most four: each after the first halves the grid's side",
    ),
]


@dataclass(frozen=True)
class UnshearNet:
    """The entangled or the disentangled UnshearNet (paper section 3.3, appendix A).

    The paper states kernels and widths in figures that its text lacks: 4x4 kernels and these widths
    are our choice. Each width is one stride-2 convolution, so the codes have a side of
    size / 2**len(widths): 8 at the paper's 256 px. At 128 px five layers (codes of side 4) learn
    faster than four: a slide moves pins by more than their spacing, so its effect shows only over a
    large field of view.
    """

    size: int = 128  # side of the images, px
    widths: Counts = (32, 64, 64, 128, 256)  # channels of each stride-2 convolution
    pose_channels: Count = 128  # channels of z_p
    shear_channels: CodeSize = 128  # channels of z_s; 0 builds no shear code and no DS
    # separate encoders: both codes are vectors, z_s has its own encoder, and DS trains neither code
    separate_encoders: bool = False
    disentangled: bool = True  # the network has codes; set by its name, so leave it
    # what all networks take: images, or pins; over pins the settings are those of the group pins
    input: Literal["images", "pins"] = "images"

    def find_problems(self) -> Iterator[Problem]:
        if len(self.widths) < 2:
            yield "widths", "list at least two"
        if self.size % 2 ** len(self.widths):
            divisor = 2 ** len(self.widths)
            yield "size", f"is not divisible by {divisor}: each width halves the image"


@dataclass(frozen=True)
class UNet:
    """A rival without codes: UnshearNet with skip connections (Ronneberger et al. 2015)."""

    size: int = 128
    widths: tuple[int, ...] = (32, 64, 64, 128, 256)

    def find_problems(self) -> Iterator[Problem]:
        yield from UnshearNet(self.size, self.widths).find_problems()


@dataclass(frozen=True)
class PoseNet:
    """The PoseNet of the paper's appendix A, with five convolutions and two dense layers.

    Max pooling follows the second and the fourth convolution; the output is a sigmoid.
    """

    size: int = 128  # side of the images, px
    widths: Counts = (16, 32, 64, 96, 128)  # channels of each convolution
    hidden: Count = 128  # units of the dense layer before the last

    def find_problems(self) -> Iterator[Problem]:
        if len(self.widths) != 5:
            yield "widths", "list five: PoseNet has five convolutions"
        if self.size % 16:
            yield "size", "is no multiple of 16, which PoseNet's strides and pooling need"


@dataclass(frozen=True)
class PinNet:
    """The networks over pins: dense layers over the motions of all pins."""

    hidden: Count = 256  # units of each dense layer
    layers: Count = 3  # number of dense layers
    # channels of E's convolutions over a grid across the pins, before one dense layer; (): dense
    # layers alone
    conv_channels: GridChannels = ()
    # channels of such convolutions in posenet_sheared, which learns poses of slides directly; other
    # PoseNets are dense
    direct_conv_channels: GridChannels = ()
    # noise that is added to the pins of training examples, px: as much as their detection errs by
    noise_px: NotNegative = 0.08
    # rotation augmentation: share of the training examples that are turned about the sensor's axis;
    # recorded ones for posenet_sheared alone, simulated ones for all networks, with slides of other
    # lengths and another camera
    rotated_share: Annotated[float, between(0, 1)] = 0.0
    pose_code: Count = 16  # numbers in z_p
    shear_code: CodeSize = 4  # numbers in z_s; 0 builds no shear code and no DS
    # separate encoders: z_s has its own, and DS trains neither code: z_p learns from the tap alone,
    # z_s from the slide
    separate_encoders: bool = False


@dataclass(frozen=True)
class PinUnshear(PinNet):
    """The network that turns sheared pins into canonical ones, by a pose code."""


@dataclass(frozen=True)
class PinPoseNet(PinNet):
    """The network that predicts a pose from pins."""


@dataclass(frozen=True)
class PinRenderer(PinNet):
    """The network that predicts the pins of a tap from its pose."""


NetSettings = UnshearNet | UNet | PoseNet | PinUnshear | PinPoseNet | PinRenderer


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
    make_settings: Callable[..., object] | None = None  # of one that an experiment file registers


REGISTRY = {
    spec.name: spec
    for spec in (
        NetworkSpec(RENDERER, "renders", "taps"),
        NetworkSpec(TEACHER, "reads poses", "taps"),
        NetworkSpec(
            ENTANGLED, "unshears", "pairs", "entangled", released_parts=("E", "DC", *PIN_CONSTANTS)
        ),
        NetworkSpec(
            DISENTANGLED,
            "unshears",
            "pairs",
            "disentangled",
            released_parts=("E", "pose", "DC", *PIN_CONSTANTS),
        ),
        NetworkSpec(POSENET, "reads poses", "taps", released_parts=()),
        NetworkSpec(ENTANGLED_LARGE, "unshears", "pairs", "entangled, as many parameters", IMAGES),
        NetworkSpec(UNET, "unshears", "pairs", "U-Net", IMAGES),
        NetworkSpec(POSENET_SHEARED, "reads poses", "slides", released_parts=()),
    )
}
TRAINABLE = REGISTRY.keys()  # with those that are registered later
NETWORKS: tuple[str, ...] = (ENTANGLED, DISENTANGLED, POSENET)  # the paper's
ALL_NETWORKS: tuple[str, ...] = (*NETWORKS, ENTANGLED_LARGE, UNET, POSENET_SHEARED)  # with rivals
# with those that are registered later; reports take the last of these that a run has;
# `TrainedModel` takes `disentangled` alone
UNSHEARING = [ENTANGLED, ENTANGLED_LARGE, UNET, DISENTANGLED]
POSENETS = tuple(name for name, spec in REGISTRY.items() if spec.role == "reads poses")


def add_network(spec: NetworkSpec) -> None:
    """Add a network that unshears, or put it in the place of one of its name."""
    if spec.name not in REGISTRY:
        UNSHEARING.insert(0, spec.name)
    REGISTRY[spec.name] = spec


def select_networks(networks: tuple[str, ...], taps: bool, slides: bool) -> tuple[str, ...]:
    """Select the networks that can be trained if there are `taps`, `slides`, or both."""
    if taps and slides:
        return networks
    if taps:
        return tuple(name for name in networks if name == POSENET)
    return (POSENET_SHEARED,) if set(networks) & set(POSENETS) else ()


def list_networks() -> tuple[str, ...]:
    """List the networks that an experiment can name, with registered ones."""
    return tuple(name for name in REGISTRY if name not in (RENDERER, TEACHER))
