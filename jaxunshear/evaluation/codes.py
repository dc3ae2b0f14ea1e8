"""Pose code and shear code of a disentangled network, over images or pins."""

from functools import partial
from pathlib import Path

import jax
import numpy as np
from jax import Array

from jaxunshear.errors import UserError
from jaxunshear.models import registry
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training.checkpoint import load_network

BATCH = 64


class CodeNetwork:
    """The compiled encoder of sheared inputs, and DS, which reconstructs them from both codes."""

    def __init__(self, net: Net, variables: Variables) -> None:
        self.net, self.variables = net, variables
        self.modality = modality = registry.get_net_modality(net)

        @jax.jit
        def encode(variables: Variables, stored: Array) -> tuple[Array, Array | None]:
            return registry.encode(net, variables, modality.scale(stored))

        self._encode = partial(encode, variables)
        self._decode = partial(jax.jit(partial(registry.decode_sheared, net)), variables)

    def encode(self, stored: np.ndarray) -> dict[str, np.ndarray]:
        """Encode inputs (N, ...) as a data set stores them; return codes (N, ...) by name."""
        count = len(stored)
        parts = []
        for start in range(0, count, BATCH):
            rows = np.arange(start, start + BATCH) % count  # all batches have one size
            parts.append(jax.device_get(self._encode(stored[rows])))
        codes = zip(("z_p", "z_s"), zip(*parts, strict=True), strict=True)
        return {name: np.concatenate(batches)[:count] for name, batches in codes}

    def decode(self, z_p: np.ndarray, z_s: np.ndarray) -> np.ndarray:
        """Reconstruct sheared inputs, images in [0, 1] or pins px, from codes (B, ...)."""
        return jax.device_get(self._decode(z_p, z_s))

    def draw_new_weights(self, seed: int) -> "CodeNetwork":
        """Draw the same network with new weights."""
        key = jax.random.key(seed)
        return CodeNetwork(self.net, registry.init_like(self.net, self.variables, key))


def load_code_network(folder: Path) -> CodeNetwork:
    """Load a network with a shear code. Raises UserError for one without, or half trained."""
    net, variables, _ = load_network(folder)
    network = CodeNetwork(net, variables)
    if not registry.has_shear_code(network.net):
        raise UserError(
            f"{folder} holds no network with a shear code: there is nothing to leak from"
        )
    return network
