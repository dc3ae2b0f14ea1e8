"""Codes exchanged: what DS draws of the pose code of one slide and the shear code of another, beside the simulated contact of just these.

Over pins or images, of data sets whose poses share slides.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PinUnshear
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.data.factorial import IMAGE, SHEARED_PINS, FactorialReader
from jaxunshear.data.reader import Reader
from jaxunshear.evaluation.bootstrap import compute_interval, number_poses, resample_means
from jaxunshear.evaluation.pin_errors import compute_half_pitch
from jaxunshear.evaluation.slide_estimation import is_slipping
from jaxunshear.files import Json
from jaxunshear.metrics.pin_error import measure_pin_error
from jaxunshear.models import pin_networks, unshearnet
from jaxunshear.models.weights import Net, Variables
from jaxunshear.perception.png import to_uint8
from jaxunshear.selection import select_evenly
from jaxunshear.training.checkpoint import load_best, read_net
from jaxunshear.training.examples import open_examples

MOST, AT_ONCE = 2000, 64  # slides, evenly chosen
SEED = 0
EXCHANGED, OWN = "exchanged", "both of its own"
GREY = "grey"  # of 1: the unit of errors of images


class ExchangedCodes(NamedTuple):
    """Poses and slides of one group, exchanged: pins (poses, slides, P, 2) px, or images (poses, slides, S, S, 1) in [0, 1].
    Column j has the shear code of slide j at pose j, row i the pose code of pose i after slide i: off the diagonal DS draws a contact that
    it was never given."""

    decoded: np.ndarray
    true: np.ndarray


class _Modality(NamedTuple):
    """What differs between networks over pins and over images."""

    field: str  # of the examples
    unit: str  # of an error
    encode: Callable[[Variables, Array], tuple[Array, Array | None]]
    draw: Callable[[Variables, Array, Array], Array]

    def read_inputs(self, reader: Reader, rows: np.ndarray) -> np.ndarray:
        """Of test contacts: images in [0, 1], pins as they are."""
        stored = reader.take("test", rows, (self.field,))[self.field]
        return stored / np.float32(255) if stored.dtype == np.uint8 else stored

    def compute_squared_errors(self, drawn: np.ndarray, true: np.ndarray) -> np.ndarray:
        """(N,) mean square difference: of a pixel's grey, or a pin's distance."""
        each = np.square(drawn - true)
        return each.mean(axis=(1, 2, 3)) if each.ndim == 4 else each.sum(-1).mean(axis=1)


def _make_modality(net: Net) -> _Modality:
    if isinstance(net, PinUnshear):
        return _Modality(
            SHEARED_PINS,
            "px",
            jax.jit(partial(pin_networks.encode, net)),
            jax.jit(partial(pin_networks.decode_sheared, net)),
        )

    @jax.jit
    def draw(variables: Variables, z_p: Array, z_s: Array) -> Array:
        return jax.nn.sigmoid(unshearnet.decode_sheared(net, variables, z_p, z_s))

    return _Modality(IMAGE, GREY, jax.jit(partial(unshearnet.encode, net)), draw)


def exchange_codes(experiment: Experiment, run_dir: Path, data_dir: Path) -> ExchangedCodes | None:
    """Of the first group of test poses that is complete; None where poses share no slides."""
    folder = Path(run_dir) / DISENTANGLED
    net, variables = read_net(folder), load_best(folder)
    reader = open_examples(experiment, DISENTANGLED, data_dir, run_dir).reader
    if not isinstance(reader, FactorialReader):
        return None
    road = _make_modality(net)
    table = reader.shared("test").row
    side = min(table.shape[1:])
    full = [rows[:side, :side] for rows in table if np.all(rows[:side, :side] >= 0)]
    if not full:
        return None
    stored = road.read_inputs(reader, full[0].reshape(-1))
    true = stored.reshape(side, side, *stored.shape[1:])
    z_p, z_s = road.encode(variables, jnp.asarray(true[np.arange(side), np.arange(side)]))
    assert z_s is not None
    every = np.indices((side, side)).reshape(2, -1)
    drawn = road.draw(variables, z_p[every[0]], z_s[every[1]])
    return ExchangedCodes(np.asarray(drawn).reshape(true.shape), true)


def measure_exchange_errors(net: Net, variables: Variables, reader: Reader) -> Json | None:
    """How far, px or grey of 1 (root mean square), what DS draws of exchanged codes is from the simulated contact of just that pose and
    slide; None where poses share no slides.

    Of images also how far the pins that are found in AT_ONCE of them lie. `by slip`: the same where the contact that the shear code was
    read from still sticks somewhere, and where all of it slips, which hides how far the slide went.
    """
    if not isinstance(reader, FactorialReader):
        return None
    road = _make_modality(net)
    rows = select_evenly(reader.length("test"), MOST)
    batch = reader.take("test", rows, ("stimulus", "pose_id"))
    others, swapped = reader.sample_partners("test", rows)
    compared = partial(_decode_exchanged, road, variables, reader, (rows, others, swapped))
    every = [
        compared(np.arange(start, start + AT_ONCE) % len(rows))
        for start in range(0, len(rows), AT_ONCE)
    ]
    squares = {
        name: np.concatenate(
            [road.compute_squared_errors(drawn[name], wanted) for drawn, wanted in every]
        )[: len(rows)]
        for name in every[0][0]
    }
    poses = number_poses(batch["stimulus"], batch["pose_id"])
    source = reader.take("test", others, ("stuck", "slipping"))
    slipped = is_slipping(source["stuck"], source["slipping"])
    changed = swapped != rows
    inside = {"sticking": changed & ~slipped, "slipped": changed & slipped}
    by_slip = [
        {"part": n, **_errors(squares, poses, those, road.unit)}
        for n, those in inside.items()
        if those.any()
    ]
    found = _errors(squares, poses, changed, road.unit)
    if road.unit == GREY:
        some = np.resize(np.flatnonzero(changed)[:: max(1, int(changed.sum()) // AT_ONCE)], AT_ONCE)
        true = reader.take("test", swapped[some], (SHEARED_PINS,))[SHEARED_PINS]
        for name, images in compared(some)[0].items():
            found["drawn"][name] |= _measure_pin_errors(images, true)
    return found | {"by slip": by_slip}


def _decode_exchanged(
    road: _Modality,
    variables: Variables,
    reader: Reader,
    partners: Sequence[np.ndarray],
    some: np.ndarray,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """What DS draws of `some` contacts, from which codes, and what it should draw. `partners`: rows of these contacts, of others after
    other slides, and of the own poses after those slides."""
    seen = [road.read_inputs(reader, rows[some]) for rows in partners]
    codes: list[Any] = [road.encode(variables, jnp.asarray(each)) for each in seen]
    pairs = {EXCHANGED: (0, 1), OWN: (2, 2), "shear code not exchanged": (0, 0)}
    drawn = {name: road.draw(variables, codes[p][0], codes[s][1]) for name, (p, s) in pairs.items()}
    return jax.device_get(drawn), seen[2]


def _measure_pin_errors(images: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """How far the pins that are found in images (B, S, S, 1) in [0, 1], matched one to one, lie from the true ones (B, P, 2) px."""
    error = measure_pin_error(to_uint8(images[..., 0]), true, compute_half_pitch(true))
    return {name: error[name] for name in ("rms_px", "missed_per_image")}


def _errors(
    squares: dict[str, np.ndarray], poses: np.ndarray, inside: np.ndarray, unit: str
) -> Json:
    """Of squared errors (N,) those `inside` (N,)."""
    squares = {name: values[inside] for name, values in squares.items()}
    means = resample_means(squares, poses[inside], SEED)
    rms = {name: float(np.sqrt(values.mean())) for name, values in squares.items()}
    drawn = {
        name: {f"rms_{unit}": rms[name], "interval": compute_interval(np.sqrt(means[name]))}
        for name in rms
    }
    ratios = np.sqrt(means[EXCHANGED] / means[OWN])
    ratio = {"ratio": rms[EXCHANGED] / rms[OWN], "ratio interval": compute_interval(ratios)}
    return {"slides": int(inside.sum()), "drawn": drawn, **ratio}
