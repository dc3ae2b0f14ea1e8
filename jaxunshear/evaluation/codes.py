"""Pose code and shear code of a disentangled network, over images or pins, and their exchange.

With exchanged codes, a sheared input is reconstructed from the pose code of one slide and the shear
code of another, and compared with the simulated contact of just that pose and that slide. This
needs a data set whose poses share slides.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import DISENTANGLED
from jaxunshear.data.reader import Reader
from jaxunshear.data.stored_sets import FactorialReader
from jaxunshear.errors import UserError
from jaxunshear.evaluation.intervals import compute_interval, resample_means
from jaxunshear.files import Json
from jaxunshear.models import registry
from jaxunshear.models.weights import Net, Variables
from jaxunshear.selection import number_poses, select_evenly
from jaxunshear.training.checkpoint import load_network
from jaxunshear.training.examples import open_examples

BATCH = 64
MAX_SLIDES = 2000  # evenly chosen
MIN_SLIP_SHARE = 0.99  # share of the touching skin that slips in a slide that counts as slipped
SEED = 0
EXCHANGED, OWN = "exchanged", "both of its own"
SHEAR_CODE_KEPT = "shear code not exchanged"


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


class ExchangedCodes(NamedTuple):
    """Reconstructions from all poses and all slides of one group, and the simulated contacts.

    Both are pins (poses, slides, P, 2) px, or images (poses, slides, S, S, 1) in [0, 1]. Entry
    (i, j) is decoded from the pose code of pose i after slide i and the shear code of slide j at
    pose j. Off the diagonal the decoder has never been given the contact that it reconstructs.
    """

    decoded: np.ndarray
    true: np.ndarray


def split_by_slip(contact_state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Say (N,) which slides still stick somewhere, and which slip everywhere.

    `contact_state` has the numbers of nodes that are `stuck` and `slipping`; nothing is known of
    recorded slides, which lack both.
    """
    if "stuck" not in contact_state:
        return {}
    stuck, slipping = contact_state["stuck"], contact_state["slipping"]
    slipped = slipping >= MIN_SLIP_SHARE * np.maximum(stuck + slipping, 1)
    return {"sticking": ~slipped, "slipped": slipped}


def exchange_codes(experiment: Experiment, run_dir: Path, data_dir: Path) -> ExchangedCodes | None:
    """Exchange the codes of the first complete group of test poses.

    None if the poses of the data set share no slides.
    """
    network = load_code_network(Path(run_dir) / DISENTANGLED)
    reader = open_examples(experiment, DISENTANGLED, data_dir, run_dir).reader
    if not isinstance(reader, FactorialReader):
        return None
    table = reader.shared("test").row
    side = min(table.shape[1:])
    complete = [rows[:side, :side] for rows in table if np.all(rows[:side, :side] >= 0)]
    if not complete:
        return None
    field = network.modality.sheared
    stored = reader.take("test", complete[0].reshape(-1), (field,))[field]
    codes = network.encode(stored[:: side + 1])  # of the diagonal
    poses, slides = np.indices((side, side)).reshape(2, -1)
    decoded = network.decode(codes["z_p"][poses], codes["z_s"][slides])
    true = network.modality.scale(stored).reshape(side, side, *stored.shape[1:])
    return ExchangedCodes(decoded.reshape(true.shape), true)


def measure_exchange_errors(network: CodeNetwork, reader: Reader) -> Json | None:
    """Measure how far reconstructions from exchanged codes are from the simulated contacts.

    Errors are root mean squares, in px or in grey of 1. `by slip` gives the same for slides whose
    partner still sticks somewhere, and for those whose partner slips everywhere, which hides how
    far it went. None if the poses of the data set share no slides.
    """
    if not isinstance(reader, FactorialReader):
        return None
    contacts = select_evenly(reader.length("test"), MAX_SLIDES)
    partners, targets = reader.sample_partners("test", contacts)
    labels = reader.take("test", contacts, ("stimulus", "pose_id"))
    poses = number_poses(labels["stimulus"], labels["pose_id"])
    squares = _compute_squared_errors(network, reader, (contacts, partners, targets))
    changed = targets != contacts
    by_slip = []
    slips = split_by_slip(reader.take("test", partners, ("stuck", "slipping")))
    for part, inside in slips.items():
        if np.any(changed & inside):
            by_slip.append({"part": part, **_summarise(network, squares, poses, changed & inside)})
    return _summarise(network, squares, poses, changed) | {"by slip": by_slip}


def _compute_squared_errors(
    network: CodeNetwork, reader: Reader, rows: Sequence[np.ndarray]
) -> dict[str, np.ndarray]:
    """Compute squared errors (N,) of reconstructions, by the codes that they are decoded from.

    `rows` (N,) are those of contacts, of partners after other slides, and of targets, which have
    the pose of the contact and the slide of the partner.
    """
    modality, count = network.modality, len(rows[0])
    inputs = [reader.take("test", each, (modality.sheared,))[modality.sheared] for each in rows]
    contact, partner, target = map(network.encode, inputs)
    codes = {
        EXCHANGED: (contact["z_p"], partner["z_s"]),
        OWN: (target["z_p"], target["z_s"]),
        SHEAR_CODE_KEPT: (contact["z_p"], contact["z_s"]),
    }
    errors: dict[str, list[np.ndarray]] = {name: [] for name in codes}
    for start in range(0, count, BATCH):
        batch = np.arange(start, start + BATCH) % count
        true = modality.scale(inputs[2][batch])
        for name, (z_p, z_s) in codes.items():
            decoded = network.decode(z_p[batch], z_s[batch])
            errors[name].append(modality.compute_squared_errors(decoded, true))
    return {name: np.concatenate(parts)[:count] for name, parts in errors.items()}


def _summarise(
    network: CodeNetwork, squares: dict[str, np.ndarray], poses: np.ndarray, inside: np.ndarray
) -> Json:
    """Compute root mean squares, their ratio and intervals over the contacts `inside` (N,)."""
    unit = network.modality.unit
    squares = {name: values[inside] for name, values in squares.items()}
    means = resample_means(squares, poses[inside], SEED)
    rms = {name: float(np.sqrt(values.mean())) for name, values in squares.items()}
    rows = {
        name: {f"rms_{unit}": rms[name], "interval": compute_interval(np.sqrt(means[name]))}
        for name in rms
    }
    return {
        "slides": int(inside.sum()),
        "drawn": rows,
        "ratio": rms[EXCHANGED] / rms[OWN],
        "ratio interval": compute_interval(np.sqrt(means[EXCHANGED] / means[OWN])),
    }
