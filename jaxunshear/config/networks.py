"""Shapes of the networks."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

from jaxunshear.config.types import Rule


@dataclass(frozen=True)
class UnshearNet:
    """Entangled or Disentangled UnshearNet (paper section 3.3, appendix A).

    The paper's figures with kernels and widths are missing from its text: 4x4 kernels and these widths are our choice.
    Each width is one stride-2 convolution, so size / 2**len(widths) is the side of the codes: 8 at the paper's 256 px. At
    128 px five layers (codes of side 4) learn faster than four: what a slide did must be judged from afar, as pins move by
    more than their spacing.
    """

    size: int = 128  # of the images, px
    widths: tuple[int, ...] = (32, 64, 64, 128, 256)  # channels a stride-2 convolution
    pose_channels: int = 128  # of z_p
    shear_channels: int = 128  # of z_s; 0 builds no shear code and no DS
    # both codes are numbers without place; z_s has an encoder of its own, and DS teaches neither code
    apart: bool = False
    disentangled: bool = True  # of a network built from these settings; experiments leave it
    # "pins": networks over pins (`PinNet`) in the place of all of these
    input: Literal["images", "pins"] = "images"

    def rules(self) -> Iterator[Rule]:
        yield (
            len(self.widths) > 1 and min(self.widths) >= 1,
            "widths",
            "list at least two positive numbers",
        )
        halvings = 2 ** len(self.widths)
        yield (
            self.size % halvings == 0,
            "size",
            f"is not divisible by {halvings}: each of the {len(self.widths)} widths halves the image",
        )
        yield self.pose_channels >= 1, "pose_channels", "must be at least 1"
        yield (
            self.shear_channels >= 0,
            "shear_channels",
            "must not be below zero; 0 builds no shear code",
        )


def drop_codes(net: UnshearNet) -> UnshearNet:
    """`net` with the channels of its codes, which an entangled network does not have, at their defaults."""
    codes = ("pose_channels", "shear_channels", "apart")
    return replace(net, **{field: getattr(UnshearNet, field) for field in codes})


@dataclass(frozen=True)
class UNet:
    """A rival without codes: UnshearNet's encoder and decoder with skip connections between them (Ronneberger et al. 2015)."""

    size: int = 128
    widths: tuple[int, ...] = (32, 64, 64, 128, 256)


@dataclass(frozen=True)
class PoseNet:
    """Five convolutions, max pooling after the 2nd and 4th, two dense layers, sigmoid output (paper appendix A)."""

    size: int = 128  # of the images, px
    widths: tuple[int, ...] = (16, 32, 64, 96, 128)  # channels a convolution
    hidden: int = 128  # units of the dense layer before the last

    def rules(self) -> Iterator[Rule]:
        yield len(self.widths) == 5, "widths", "list five: PoseNet has five convolutions"
        yield min(self.widths) >= 1, "widths", "list positive numbers"
        yield (
            self.size % 16 == 0,
            "size",
            "is no multiple of 16, which PoseNet's strides and pooling need",
        )
        yield self.hidden >= 1, "hidden", "must be at least 1"


@dataclass(frozen=True)
class PinNet:
    """Networks over pins: dense layers over the motions of all pins."""

    hidden: int = 256  # units a dense layer
    layers: int = 3  # dense layers
    # channels of E's convolutions over a grid across the pins, then one dense layer; (): dense layers alone
    convolved: tuple[int, ...] = ()
    # the same of posenet_sheared, which learns poses of slides directly; other PoseNets are dense
    direct_convolved: tuple[int, ...] = ()
    # added to the pins of training examples: as much as finding them errs by
    noise_px: float = 0.08
    # share of the examples that are turned about the sensor's axis: of recorded ones posenet_sheared's; of simulated ones all networks',
    # and these are dragged further or less, and seen by another camera, too
    turned: float = 0.0
    pose_code: int = 16  # numbers in z_p
    shear_code: int = 4  # numbers in z_s; 0 builds no shear code and no DS
    # z_s comes from a trunk of its own, and DS teaches neither code: z_p learns from the tap alone, z_s from the slide
    apart: bool = False

    def rules(self) -> Iterator[Rule]:
        for field in ("hidden", "layers", "pose_code"):
            yield getattr(self, field) >= 1, field, "must be at least 1"
        for field in ("convolved", "direct_convolved"):
            channels = getattr(self, field)
            yield all(each >= 1 for each in channels), field, "list positive numbers, or none"
            remedy = "list at most four: each after the first halves the grid's side"
            yield len(channels) <= 4, field, remedy
        yield self.shear_code >= 0, "shear_code", "must not be below zero; 0 builds no shear code"
        yield self.noise_px >= 0, "noise_px", "must not be below zero"
        yield 0 <= self.turned <= 1, "turned", "use a share from 0 to 1"


def drop_pin_codes(net: PinNet) -> PinNet:
    """`net` with what only PinUnshear reads at its default."""
    codes = ("convolved", "pose_code", "shear_code", "apart")
    return replace(net, **{field: getattr(PinNet, field) for field in codes})


def drop_direct(net: PinNet) -> PinNet:
    """Return `net` with what only posenet_sheared reads at its default."""
    return replace(net, direct_convolved=PinNet.direct_convolved)


def drop_rotation(net: PinNet) -> PinNet:
    """`net` with nothing turned: what only training reads."""
    return replace(net, turned=PinNet.turned)


@dataclass(frozen=True)
class PinUnshear(PinNet):
    """Sheared pins to canonical ones, by a pose code."""


@dataclass(frozen=True)
class PinPoseNet(PinNet):
    """Pins to pose."""


@dataclass(frozen=True)
class PinRenderer(PinNet):
    """Pose to the pins of a tap there."""
