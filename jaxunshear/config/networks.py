"""Settings of the networks: their sizes and parts."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

from jaxunshear.config.types import Rule


@dataclass(frozen=True)
class UnshearNet:
    """The entangled or the disentangled UnshearNet (paper section 3.3, appendix A).

    The paper states kernels and widths in figures that its text lacks: 4x4 kernels and these widths
    are our choice. Each width is one stride-2 convolution, so the codes have a side of
    size / 2**len(widths): 8 at the paper's 256 px. At 128 px five layers (codes of side 4) learn
    faster than four: a slide moves pins by more than their spacing, so its effect shows only over a
    large field of view.
    """

    size: int = 128  # of the images, px
    widths: tuple[int, ...] = (32, 64, 64, 128, 256)  # channels a stride-2 convolution
    pose_channels: int = 128  # of z_p
    shear_channels: int = 128  # of z_s; 0 builds no shear code and no DS
    # both codes are vectors without place; z_s has its own encoder, and DS trains neither code
    apart: bool = False
    disentangled: bool = True  # of a network built from these settings; experiments leave it True
    # "pins": networks over pins (`PinNet`) instead of these
    input: Literal["images", "pins"] = "images"

    def rules(self) -> Iterator[Rule]:
        yield Rule(
            len(self.widths) > 1 and min(self.widths) >= 1,
            "widths",
            "list at least two positive numbers",
        )
        halvings = 2 ** len(self.widths)
        yield Rule(
            self.size % halvings == 0,
            "size",
            f"is not divisible by {halvings}: "
            f"each of the {len(self.widths)} widths halves the image",
        )
        yield Rule(self.pose_channels >= 1, "pose_channels", "must be at least 1")
        yield Rule(
            self.shear_channels >= 0,
            "shear_channels",
            "must not be below zero; 0 builds no shear code",
        )


def drop_codes(net: UnshearNet) -> UnshearNet:
    """Set the channels of the codes, which an entangled network does not have, to defaults."""
    return replace(
        net,
        pose_channels=UnshearNet.pose_channels,
        shear_channels=UnshearNet.shear_channels,
        apart=UnshearNet.apart,
    )


@dataclass(frozen=True)
class UNet:
    """A rival without codes: UnshearNet with skip connections (Ronneberger et al. 2015)."""

    size: int = 128
    widths: tuple[int, ...] = (32, 64, 64, 128, 256)

    def rules(self) -> Iterator[Rule]:
        yield from UnshearNet(self.size, self.widths).rules()


@dataclass(frozen=True)
class PoseNet:
    """The PoseNet of the paper's appendix A, with five convolutions and two dense layers.

    Max pooling follows the second and the fourth convolution; the output is a sigmoid.
    """

    size: int = 128  # of the images, px
    widths: tuple[int, ...] = (16, 32, 64, 96, 128)  # channels a convolution
    hidden: int = 128  # units of the dense layer before the last

    def rules(self) -> Iterator[Rule]:
        yield Rule(len(self.widths) == 5, "widths", "list five: PoseNet has five convolutions")
        yield Rule(min(self.widths) >= 1, "widths", "list positive numbers")
        yield Rule(
            self.size % 16 == 0,
            "size",
            "is no multiple of 16, which PoseNet's strides and pooling need",
        )
        yield Rule(self.hidden >= 1, "hidden", "must be at least 1")


@dataclass(frozen=True)
class PinNet:
    """The networks over pins: dense layers over the motions of all pins."""

    hidden: int = 256  # units a dense layer
    layers: int = 3  # number of dense layers
    # channels of E's convolutions over a grid across the pins, before one dense layer; (): dense
    # layers alone
    convolved: tuple[int, ...] = ()
    # likewise of posenet_sheared, which learns poses of slides directly; other PoseNets are dense
    direct_convolved: tuple[int, ...] = ()
    # added to the pins of training examples: as much as their detection errs by
    noise_px: float = 0.08
    # rotation augmentation: share of the training examples that are turned about the sensor's axis;
    # recorded ones for posenet_sheared alone, simulated ones for all networks, with slides of other
    # lengths and another camera
    turned: float = 0.0
    pose_code: int = 16  # numbers in z_p
    shear_code: int = 4  # numbers in z_s; 0 builds no shear code and no DS
    # z_s has an encoder of its own, and DS trains neither code: z_p learns from the tap alone, z_s
    # from the slide
    apart: bool = False

    def rules(self) -> Iterator[Rule]:
        for field in ("hidden", "layers", "pose_code"):
            yield Rule(getattr(self, field) >= 1, field, "must be at least 1")
        for field in ("convolved", "direct_convolved"):
            channels = getattr(self, field)
            yield Rule(all(each >= 1 for each in channels), field, "list positive numbers, or none")
            remedy = "list at most four: each after the first halves the grid's side"
            yield Rule(len(channels) <= 4, field, remedy)
        yield Rule(
            self.shear_code >= 0, "shear_code", "must not be below zero; 0 builds no shear code"
        )
        yield Rule(self.noise_px >= 0, "noise_px", "must not be below zero")
        yield Rule(0 <= self.turned <= 1, "turned", "use a share from 0 to 1")


def drop_pin_codes(net: PinNet) -> PinNet:
    """Set what only PinUnshear reads to its defaults."""
    return replace(
        net,
        convolved=PinNet.convolved,
        pose_code=PinNet.pose_code,
        shear_code=PinNet.shear_code,
        apart=PinNet.apart,
    )


def drop_direct(net: PinNet) -> PinNet:
    """Set what only posenet_sheared reads to its default."""
    return replace(net, direct_convolved=PinNet.direct_convolved)


def drop_rotation(net: PinNet) -> PinNet:
    """Set the rotation augmentation, which only training reads, to its default."""
    return replace(net, turned=PinNet.turned)


@dataclass(frozen=True)
class PinUnshear(PinNet):
    """The network that turns sheared pins into canonical ones, by a pose code."""


@dataclass(frozen=True)
class PinPoseNet(PinNet):
    """The network that predicts a pose from pins."""


@dataclass(frozen=True)
class PinRenderer(PinNet):
    """The network that predicts the pins of a tap from its pose."""
