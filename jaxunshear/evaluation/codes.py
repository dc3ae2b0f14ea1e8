"""Pose code and shear code of a disentangled network, over images or pins, a row for each input."""

from collections.abc import Callable

import jax
import numpy as np

from jaxunshear.models.registry import encode as encode_inputs
from jaxunshear.models.registry import get_net_modality, has_shear_code
from jaxunshear.models.weights import Net, Variables

ENCODE_BATCH = 64

Encode = Callable[[np.ndarray], dict[str, np.ndarray]]  # inputs -> codes (N, F) by name


def make_encoder(net: Net, variables: Variables) -> Encode | None:
    """Make a function from stored inputs to codes (N, F) by name; None without a shear code."""
    modality = get_net_modality(net)
    if not has_shear_code(net):
        return None

    @jax.jit
    def run(weights: Variables, stored: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        return encode_inputs(net, weights, modality.scale(stored))

    def encode(stored: np.ndarray) -> dict[str, np.ndarray]:
        count = len(stored)
        pose_codes, shear_codes = [], []
        for start in range(0, count, ENCODE_BATCH):
            rows = np.arange(start, start + ENCODE_BATCH) % count  # all batches have one size
            z_p, z_s = jax.device_get(run(variables, stored[rows]))
            pose_codes.append(z_p)
            shear_codes.append(z_s)
        return {
            "z_p": np.concatenate(pose_codes)[:count].reshape(count, -1),
            "z_s": np.concatenate(shear_codes)[:count].reshape(count, -1),
        }

    return encode
