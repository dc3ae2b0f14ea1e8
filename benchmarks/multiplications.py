"""Counts multiplications of the networks in one pass of an image."""

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.targets import count_outputs, make_range_targets

TARGETS = make_range_targets((), Ranges())


def count_multiplications(net: UnshearNet, training: bool) -> int:
    """Count multiplications of all convolutions in one forward pass of an image.

    With `training` False only encoder, pose code and DC count.
    """
    widths, side, count = net.widths, net.size, 0
    for before, width in zip((1, *widths), widths, strict=False):
        side //= 2
        count += 16 * before * width * side * side
    shear = net.shear_channels if net.disentangled and training else 0
    pose = net.pose_channels if net.disentangled else 0
    codes = [pose or widths[-1]] + ([pose + shear] if shear else [])
    if net.separate_encoders:  # dense layers from and to numbers without place; z_s by a PoseNet
        count += widths[-1] * side * side * (pose + sum(codes))
        count += count_posenet_multiplications(PoseNet(net.size)) if shear else 0
    else:
        count += 9 * widths[-1] * (pose + shear) * side * side
    decoders = [widths[-1] for _ in codes] if net.separate_encoders else codes
    for code in decoders:
        here, outwards = side, (*reversed(widths[:-1]), 1)
        for before, width in zip((code, *outwards), outwards, strict=False):
            count += 16 * before * width * here * here
            here *= 2
    return count


def count_posenet_multiplications(net: PoseNet) -> int:
    """Count multiplications of PoseNet in one forward pass of an image."""
    first, second, *rest = net.widths
    side = net.size // 4
    count = 16 * first * (2 * side) ** 2 + 16 * first * second * side**2
    count += 9 * (second * rest[0] + rest[0] * rest[1]) * (side // 2) ** 2
    count += 9 * rest[1] * rest[2] * (side // 4) ** 2
    count += (side // 4) ** 2 * rest[2] * net.hidden
    return count + net.hidden * count_outputs(TARGETS)
