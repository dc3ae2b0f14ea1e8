"""Entangled and Disentangled UnshearNet (paper section 3.3, appendix A) behind pure functions.

>>> variables = init(net, jax.random.key(0))
>>> z_p, z_s = encode(net, variables, sheared)  # (B, S, S, 1) in [0, 1] -> (B, s, s, channels) each
>>> canonical = jax.nn.sigmoid(decode_canonical(net, variables, z_p))
>>> canonical = unshear(net, variables, sheared)  # both steps in one

E encodes, DC decodes the pose code z_p to the canonical (tap) image, DS decodes both codes to the
sheared one. The entangled network has one code and DC alone; its z_s is None. Inputs are binary
images scaled to [0, 1], decoders return logits.

Codes of `separate_encoders` are ours, not the paper's: both are a few numbers without place,
(B, 1, 1, channels), and z_s has an encoder of its own, ES.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxunshear.config.networks import UnshearNet
from jaxunshear.config.types import raise_first_problem
from jaxunshear.models import layer_choice
from jaxunshear.models.fast import networks as fast
from jaxunshear.models.layers import Down, Last, Same, Up, VectorCode, VectorDecoder
from jaxunshear.models.reconstruction import Reconstruction, measure_disagreement
from jaxunshear.models.weights import Images, Variables, check_has_sheared_decoder, has_part


class Encoder(nn.Module):
    """E: an image (B, S, S, 1) -> (B, S / 2**layers, S / 2**layers, widths[-1])."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        x = Down(self.widths[0], name="First_0")(x, train)
        for width in self.widths[1:]:
            x = Down(width)(x, train)
        return x


class Decoder(nn.Module):
    """DC and DS, the encoder's mirror: a code -> logits of an image (B, S, S, 1)."""

    widths: tuple[int, ...]  # the encoder's

    @nn.compact
    def __call__(self, z: Array, train: bool) -> Array:
        for width in reversed(self.widths[:-1]):
            z = Up(width)(z, train)
        return Last()(z, train)


class Network(nn.Module):
    """All parts under their names in the paper; use the functions below."""

    net: UnshearNet

    def setup(self) -> None:
        net = self.net
        encoder = layer_choice.pick_layer(Encoder, fast.Encoder)
        decoder: Callable[[], nn.Module] = partial(
            layer_choice.pick_layer(Decoder, fast.Decoder), net.widths
        )
        code: Callable[..., nn.Module] = layer_choice.pick_layer(Same, fast.Same)
        shear_code = code
        if net.separate_encoders:
            code, shear_code = VectorCode, partial(VectorCode, normalise=False)
            side = net.size // 2 ** len(net.widths)
            decoder = partial(VectorDecoder, (side, side, net.widths[-1]), decoder)
        self.E, self.DC = encoder(net.widths), decoder()
        if net.disentangled:
            self.pose = code(net.pose_channels)
            if net.shear_channels:
                self.shear = shear_code(net.shear_channels)
                self.DS = decoder()
        if net.separate_encoders:
            self.ES = encoder(net.widths)

    def encode_pose(self, images: Array, train: bool) -> Array:
        z = self.E(images, train)
        return self.pose(z, train) if self.net.disentangled else z

    def encode(self, images: Array, train: bool) -> tuple[Array, Array | None]:
        z = self.E(images, train)
        if not self.net.disentangled:
            return z, None
        if not self.net.shear_channels:
            return self.pose(z, train), None
        z_p = self.pose(z, train)
        if self.net.separate_encoders:
            return z_p, self.encode_slide(images, train)
        return z_p, self.shear(z, train)

    def encode_slide(self, images: Array, train: bool) -> Array:
        return self.shear(self.ES(images, train), train)

    def decode_canonical(self, z_p: Array, train: bool) -> Array:
        return self.DC(z_p, train)

    def decode_sheared(self, z_p: Array, z_s: Array, train: bool) -> Array:
        return self.DS(jnp.concatenate([z_p, z_s], -1), train)

    def unshear(self, images: Array, train: bool) -> Array:
        return jax.nn.sigmoid(self.DC(self.encode_pose(images, train), train))

    def __call__(
        self, images: Array, same_pose: Array | None = None, same_slide: Array | None = None
    ) -> Reconstruction:
        """Run both decoders in training."""
        if not self.net.separate_encoders:
            z_p, z_s = self.encode(images, True)
            sheared = None if z_s is None else self.decode_sheared(z_p, z_s, True)
            return Reconstruction(self.DC(z_p, True), z_p, sheared, z_s=z_s)
        z_p, second_z_p = _run_both(images, same_pose, lambda x: self.encode_pose(x, True))
        z_s, second_z_s = _run_both(images, same_slide, lambda x: self.encode_slide(x, True))
        fixed_z_p = jax.lax.stop_gradient(z_p)  # DS does not teach the codes

        def decode_slides(z: Array) -> Array:
            repeated = jnp.concatenate([fixed_z_p] * (z.shape[0] // fixed_z_p.shape[0]))
            return self.decode_sheared(repeated, jax.lax.stop_gradient(z), True)

        sheared, counterfactual = _run_both(z_s, second_z_s, decode_slides)
        canonical, same_pose_canonical = _run_both(z_p, second_z_p, lambda z: self.DC(z, True))
        disagreement = None if second_z_p is None else measure_disagreement(z_p, second_z_p)
        return Reconstruction(
            canonical, z_p, sheared, counterfactual, disagreement, z_s, same_pose_canonical
        )


def init(net: UnshearNet, key: Array) -> Variables:
    """Make fresh variables. Raises UserError if `size` and `widths` do not fit each other."""
    raise_first_problem(net, "UnshearNet")
    # the shapes of networks with one encoder do not depend on the image's
    side = net.size if net.separate_encoders else 2 ** len(net.widths)
    with layer_choice.use_layers(layer_choice.FAST):  # for the same weights with any layers
        return dict(Network(net).init(key, jnp.zeros((1, side, side, 1))))


@cache  # a search for a rival asks of the same networks again
def count_parameters(net: UnshearNet) -> int:
    """Count the numbers that are trained."""
    shapes = jax.eval_shape(lambda key: init(net, key)["params"], jax.random.key(0))
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))


def match_entangled_size(net: UnshearNet) -> UnshearNet:
    """Scale all widths of `net` to an entangled network with as many parameters.

    The number is as near as multiples of 4 allow (other widths are slow). This is the fair rival of
    a disentangled network, which also has a second decoder and two codes.
    """
    target = count_parameters(net)

    def scale_widths(ratio: float) -> UnshearNet:
        widths = tuple(max(4, 4 * round(ratio * width / 4)) for width in net.widths)
        return dataclasses.replace(net, widths=widths, disentangled=False, separate_encoders=False)

    low, high = 0.25, 4.0
    while count_parameters(scale_widths(high)) < target:
        low, high = high, 2 * high
    for _ in range(12):  # parameters grow with the ratio
        middle = (low + high) / 2
        if count_parameters(scale_widths(middle)) < target:
            low = middle
        else:
            high = middle
    rivals = (scale_widths(low), scale_widths(high))
    return min(rivals, key=lambda rival: abs(count_parameters(rival) - target))


def encode(
    net: UnshearNet, variables: Variables, images: Images
) -> tuple[Float[Array, "B s s _"], Float[Array, "B _ _ _"] | None]:
    """Encode images in [0, 1] as (z_p, z_s), by channels.

    z_s is None without a shear code, as in released weights.
    """
    if net.disentangled and net.shear_channels and not has_part(variables, "shear"):
        return _apply(net, variables, "encode_pose", images), None
    return _apply(net, variables, "encode", images)


def decode_canonical(net: UnshearNet, variables: Variables, z_p: Float[Array, "B s s _"]) -> Images:
    """Decode the pose code by DC to logits of the canonical image."""
    return _apply(net, variables, "decode_canonical", z_p)


def decode_sheared(
    net: UnshearNet,
    variables: Variables,
    z_p: Float[Array, "B s s _"],
    z_s: Float[Array, "B _ _ _"],
) -> Images:
    """Decode both codes by DS to logits of the sheared image.

    Raises UserError for released weights, which leave DS out.
    """
    check_has_sheared_decoder(variables)
    return _apply(net, variables, "decode_sheared", z_p, z_s)


def unshear(net: UnshearNet, variables: Variables, images: Images) -> Images:
    """Unshear images in [0, 1], with neither the shear code nor DS."""
    return _apply(net, variables, "unshear", images)


def reconstruct(
    net: UnshearNet,
    variables: Variables,
    images: Images,
    key: Array | None = None,
    same_pose: Images | None = None,
    same_slide: Images | None = None,
) -> tuple[Reconstruction, Variables]:
    """Run both decoders over sheared images; return the running statistics, updated in training.

    Codes of `separate_encoders`, which DS does not teach, take second contacts.

    Args:
        key: any key in training; else None, and second contacts are not used.
        same_pose: taps at the same poses, or contacts there after other slides: their pose codes
            should agree.
        same_slide: contacts at other poses after these other slides: DS also decodes their shear
            code.
    """
    if key is None:
        z_p, z_s = encode(net, variables, images)
        sheared = None if z_s is None else decode_sheared(net, variables, z_p, z_s)
        canonical = decode_canonical(net, variables, z_p)
        return Reconstruction(canonical, z_p, sheared, z_s=z_s), variables["batch_stats"]
    reconstruction, updates = Network(net).apply(
        variables, images, same_pose, same_slide, mutable=["batch_stats"]
    )
    return reconstruction, updates["batch_stats"]


def _run_both(
    images: Array, others: Array | None, run: Callable[[Array], Array]
) -> tuple[Array, Array | None]:
    """Apply `run` to both in one batch, whose statistics are of both."""
    if others is None:
        return run(images), None
    first, second = jnp.split(run(jnp.concatenate([images, others])), 2)
    return first, second


def _apply(net: UnshearNet, variables: Variables, method: str, *inputs: Array) -> Any:
    return Network(net).apply(variables, *inputs, False, method=method)
