"""Pose code and shear code of a disentangled network, over images or pins, a row for each input."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.config.networks import PinUnshear, UnshearNet
from jaxunshear.models import pin_networks, unshearnet
from jaxunshear.models.weights import Net, Variables

ENCODE_BATCH = 64

Encode = Callable[[np.ndarray], dict[str, np.ndarray]]  # inputs -> codes (N, F) by name


def make_encoder(net: Net, variables: Variables) -> Encode | None:
    """Inputs -> codes (N, F) by name; None without a shear code."""
    if isinstance(net, PinUnshear) and net.shear_code:
        run = jax.jit(partial(pin_networks.encode, net))
    elif isinstance(net, UnshearNet) and net.disentangled and net.shear_channels:
        run = jax.jit(
            lambda weights, images: unshearnet.encode(
                net, weights, images.astype(jnp.float32) / 255
            )
        )
    else:
        return None

    def encode(seen: np.ndarray) -> dict[str, np.ndarray]:
        parts = []
        for start in range(0, len(seen), ENCODE_BATCH):
            rows = np.arange(start, start + ENCODE_BATCH) % len(seen)
            parts.append(jax.device_get(run(variables, seen[rows])))
        joined = [np.concatenate(part)[: len(seen)] for part in zip(*parts, strict=True)]
        return {
            name: code.reshape(len(seen), -1)
            for name, code in zip(("z_p", "z_s"), joined, strict=True)
        }

    return encode


def init_untrained(net: Net, variables: Variables, seed: int) -> Variables:
    """Fresh variables of the network."""
    key = jax.random.key(seed)
    if isinstance(net, PinUnshear):
        constants = variables["batch_stats"]
        return pin_networks.init(net, constants["rest"], constants["spread"], key)
    return unshearnet.init(net, key)
