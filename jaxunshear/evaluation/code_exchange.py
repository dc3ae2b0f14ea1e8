"""Exchange codes: reconstruct from the pose code of one slide and the shear code of another.

The reconstruction is compared with the simulated contact of just that pose and that slide. It needs
a data set whose poses share slides, and works over images and pins.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.data.factorial import FactorialReader
from jaxunshear.data.reader import Reader
from jaxunshear.evaluation.bootstrap import compute_interval, number_poses, resample_means
from jaxunshear.evaluation.pin_errors import compute_half_pitch
from jaxunshear.evaluation.slide_estimation import is_slipping
from jaxunshear.files import Json
from jaxunshear.metrics.pin_error import measure_pin_error
from jaxunshear.models.modality import IMAGES, PINS, Modality
from jaxunshear.models.registry import decode_sheared, encode, get_net_modality
from jaxunshear.models.weights import Net, Variables
from jaxunshear.perception.png import to_uint8
from jaxunshear.selection import select_evenly
from jaxunshear.training.checkpoint import load_best, read_net
from jaxunshear.training.examples import open_examples

MAX_SLIDES, BATCH = 2000, 64  # slides are evenly chosen
SEED = 0
EXCHANGED, OWN = "exchanged", "both of its own"
SHEAR_CODE_KEPT = "shear code not exchanged"


class ExchangedCodes(NamedTuple):
    """Reconstructions from all poses and all slides of one group, and the simulated contacts.

    Both are pins (poses, slides, P, 2) px, or images (poses, slides, S, S, 1) in [0, 1]. Entry
    (i, j) is decoded from the pose code of pose i after slide i and the shear code of slide j at
    pose j. Off the diagonal the decoder has never been given the contact that it reconstructs.
    """

    decoded: np.ndarray
    true: np.ndarray


class _CodeNetwork(NamedTuple):
    """Encoder and decoder of sheared inputs, compiled, with their weights."""

    modality: Modality
    variables: Variables
    encode: Callable[[Variables, Array], tuple[Array, Array | None]]
    decode: Callable[[Variables, Array, Array], Array]

    def read_inputs(self, reader: Reader, rows: np.ndarray) -> np.ndarray:
        """Read scaled inputs of test contacts."""
        field = self.modality.sheared
        return self.modality.scale(reader.take("test", rows, (field,))[field])


class _ExchangeRows(NamedTuple):
    """Rows (N,) of test contacts, of partners after other slides, and of targets.

    A target has the pose of the contact and the slide of the partner.
    """

    contacts: np.ndarray
    partners: np.ndarray
    targets: np.ndarray

    def select(self, some: np.ndarray) -> "_ExchangeRows":
        return _ExchangeRows(*(rows[some] for rows in self))


def _make_code_network(net: Net, variables: Variables) -> _CodeNetwork:
    modality = get_net_modality(net)
    return _CodeNetwork(
        modality,
        variables,
        jax.jit(partial(encode, net)),
        jax.jit(partial(decode_sheared, net)),
    )


def exchange_codes(experiment: Experiment, run_dir: Path, data_dir: Path) -> ExchangedCodes | None:
    """Exchange the codes of the first complete group of test poses.

    None if the poses of the data set share no slides.
    """
    folder = Path(run_dir) / DISENTANGLED
    network = _make_code_network(read_net(folder), load_best(folder))
    reader = open_examples(experiment, DISENTANGLED, data_dir, run_dir).reader
    if not isinstance(reader, FactorialReader):
        return None
    table = reader.shared("test").row
    side = min(table.shape[1:])
    complete = [rows[:side, :side] for rows in table if np.all(rows[:side, :side] >= 0)]
    if not complete:
        return None
    inputs = network.read_inputs(reader, complete[0].reshape(-1))
    true = inputs.reshape(side, side, *inputs.shape[1:])
    diagonal = np.arange(side)
    z_p, z_s = network.encode(network.variables, jnp.asarray(true[diagonal, diagonal]))
    assert z_s is not None
    poses, slides = np.indices((side, side)).reshape(2, -1)
    decoded = network.decode(network.variables, z_p[poses], z_s[slides])
    return ExchangedCodes(np.asarray(decoded).reshape(true.shape), true)


def measure_exchange_errors(net: Net, variables: Variables, reader: Reader) -> Json | None:
    """Measure how far reconstructions from exchanged codes are from the simulated contacts.

    Errors are root mean squares, in px or in grey of 1. For images also the pins that are detected
    in BATCH of them are compared. `by slip` gives the same for slides whose partner still sticks
    somewhere, and for those whose partner slips everywhere, which hides how far it went.
    None if the poses of the data set share no slides.
    """
    if not isinstance(reader, FactorialReader):
        return None
    network = _make_code_network(net, variables)
    contacts = select_evenly(reader.length("test"), MAX_SLIDES)
    labels = reader.take("test", contacts, ("stimulus", "pose_id"))
    poses = number_poses(labels["stimulus"], labels["pose_id"])
    rows = _ExchangeRows(contacts, *reader.sample_partners("test", contacts))
    squares = _compute_squared_errors(network, reader, rows)
    contact_state = reader.take("test", rows.partners, ("stuck", "slipping"))
    slipping = is_slipping(contact_state["stuck"], contact_state["slipping"])
    changed = rows.targets != rows.contacts
    unit = network.modality.unit
    by_slip = []
    for part, inside in (("sticking", changed & ~slipping), ("slipped", changed & slipping)):
        if inside.any():
            by_slip.append({"part": part, **_summarise(squares, poses, inside, unit)})
    summary = _summarise(squares, poses, changed, unit)
    if network.modality is IMAGES:
        step = max(1, int(changed.sum()) // BATCH)
        some = rows.select(np.resize(np.flatnonzero(changed)[::step], BATCH))
        true_pins = reader.take("test", some.targets, (PINS.sheared,))[PINS.sheared]
        decoded, _ = _decode_exchanges(network, reader, some)
        for name, images in decoded.items():
            summary["drawn"][name] |= _measure_pin_errors(images, true_pins)
    return summary | {"by slip": by_slip}


def _compute_squared_errors(
    network: _CodeNetwork, reader: Reader, rows: _ExchangeRows
) -> dict[str, np.ndarray]:
    """Compute squared errors (N,) of reconstructions, by the codes that they are decoded from."""
    count = len(rows.contacts)
    parts: dict[str, list[np.ndarray]] = {}
    for start in range(0, count, BATCH):
        batch = rows.select(np.arange(start, start + BATCH) % count)
        decoded, targets = _decode_exchanges(network, reader, batch)
        for name, values in decoded.items():
            errors = network.modality.compute_squared_errors(values, targets)
            parts.setdefault(name, []).append(errors)
    return {name: np.concatenate(errors)[:count] for name, errors in parts.items()}


def _decode_exchanges(
    network: _CodeNetwork, reader: Reader, rows: _ExchangeRows
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Decode exchanged and other codes, by name; also return the inputs that are the targets."""
    inputs = [network.read_inputs(reader, each) for each in rows]
    codes = [network.encode(network.variables, jnp.asarray(each)) for each in inputs]
    contact, partner, target = codes
    choices = {
        EXCHANGED: (contact[0], partner[1]),
        OWN: (target[0], target[1]),
        SHEAR_CODE_KEPT: (contact[0], contact[1]),
    }
    decoded = {}
    for name, (z_p, z_s) in choices.items():
        assert z_s is not None
        decoded[name] = network.decode(network.variables, z_p, z_s)
    return jax.device_get(decoded), inputs[2]


def _measure_pin_errors(images: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Measure how far pins detected in images (B, S, S, 1) in [0, 1] are from true ones, px."""
    error = measure_pin_error(to_uint8(images[..., 0]), true, compute_half_pitch(true))
    return {name: error[name] for name in ("rms_px", "missed_per_image")}


def _summarise(
    squares: dict[str, np.ndarray], poses: np.ndarray, inside: np.ndarray, unit: str
) -> Json:
    """Compute root mean squares, their ratio and intervals over the contacts `inside` (N,)."""
    squares = {name: values[inside] for name, values in squares.items()}
    means = resample_means(squares, poses[inside], SEED)
    rms = {name: float(np.sqrt(values.mean())) for name, values in squares.items()}
    rows = {
        name: {f"rms_{unit}": rms[name], "interval": compute_interval(np.sqrt(means[name]))}
        for name in rms
    }
    ratios = np.sqrt(means[EXCHANGED] / means[OWN])
    return {
        "slides": int(inside.sum()),
        "drawn": rows,
        "ratio": rms[EXCHANGED] / rms[OWN],
        "ratio interval": compute_interval(ratios),
    }
