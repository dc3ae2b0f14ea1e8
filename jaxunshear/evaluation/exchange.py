"""Codes exchanged: what DS draws of the pose code of one slide and the shear code of another, beside the simulated contact of just these.

For networks over pins, of data sets whose poses share slides.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.dataset.factorial import FEEDS, OTHER, SWAPPED, FactorialReader
from jaxunshear.dataset.reading import Reader
from jaxunshear.evaluation.slide import slipping
from jaxunshear.evaluation.spread import interval, numbered_poses, redrawn_means
from jaxunshear.model import pinnets
from jaxunshear.model.parts import Net, Variables
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.networks import PinUnshear
from jaxunshear.settings.registry import DISENTANGLED
from jaxunshear.storage import Json
from jaxunshear.training.checkpoint import load_best, read_net
from jaxunshear.training.examples import open_examples

MOST = 2000  # slides, evenly chosen
SEED = 0
EXCHANGED, OWN = "exchanged", "both of its own"


class Exchanged(NamedTuple):
    """Poses and slides of one group, exchanged: pins (poses, slides, P, 2) px. Column j has the shear code of slide j at pose j, row i the
    pose code of pose i after slide i: off the diagonal DS draws a contact that it was never given."""

    drawn: np.ndarray
    true: np.ndarray


def exchanged(experiment: Experiment, run_dir: Path, data_dir: Path) -> Exchanged | None:
    """Of the first group of test poses that is complete; None where poses share no slides, or the network reads images."""
    folder = Path(run_dir) / DISENTANGLED
    net, variables = read_net(folder), load_best(folder)
    reader = open_examples(experiment, DISENTANGLED, data_dir, run_dir).reader
    if not isinstance(reader, FactorialReader) or not isinstance(net, PinUnshear):
        return None
    table = reader.shared("test").row
    side = min(table.shape[1:])
    full = [rows[:side, :side] for rows in table if np.all(rows[:side, :side] >= 0)]
    if not full:
        return None
    true = reader.take("test", full[0].reshape(-1), (FEEDS,))[FEEDS].reshape(side, side, -1, 2)
    z_p, z_s = pinnets.encode(net, variables, jnp.asarray(true[np.arange(side), np.arange(side)]))
    assert z_s is not None
    every = np.indices((side, side)).reshape(2, -1)
    drawn = pinnets.decode_sheared(net, variables, z_p[every[0]], z_s[every[1]])
    return Exchanged(np.asarray(drawn).reshape(true.shape), true)


def errors_of(net: Net, variables: Variables, reader: Reader) -> Json | None:
    """How far, px (root mean square), what DS draws of exchanged codes is from the simulated contact of just that pose and slide; None
    where poses share no slides, or the network reads images.

    `by slip`: the same where the contact that the shear code was read from still sticks somewhere, and where all of it slips, which
    hides how far the slide went.
    """
    if not isinstance(reader, FactorialReader) or not isinstance(net, PinUnshear):
        return None
    count = reader.length("test")
    rows = np.linspace(0, count - 1, min(MOST, count)).round().astype(int)
    batch = reader.take("test", rows, (FEEDS, OTHER, SWAPPED, "stimulus", "pose_id"))
    source = reader.take("test", reader.partners("test", rows)[0], ("stuck", "slipping"))
    own, other, wanted = (batch[name] for name in (FEEDS, OTHER, SWAPPED))

    @jax.jit
    def drawn(weights: pinnets.Variables, own: Array, other: Array, wanted: Array) -> dict[str, Array]:
        codes: list[Any] = [pinnets.encode(net, weights, pins) for pins in (own, other, wanted)]
        pairs = {EXCHANGED: (0, 1), OWN: (2, 2), "shear code not exchanged": (0, 0)}
        return {n: pinnets.decode_sheared(net, weights, codes[p][0], codes[s][1]) for n, (p, s) in pairs.items()}

    found = drawn(variables, own, other, wanted)
    poses = numbered_poses(batch["stimulus"], batch["pose_id"])
    squares = {n: np.sum(np.square(np.asarray(pins) - wanted), -1).mean(axis=1) for n, pins in found.items()}
    slipped = slipping(source["stuck"], source["slipping"])
    changed = np.any(own != wanted, axis=(1, 2))
    parts = {"sticking": changed & ~slipped, "slipped": changed & slipped}
    by_slip = [{"part": part, **_errors(squares, poses, inside)} for part, inside in parts.items() if inside.any()]
    return _errors(squares, poses, changed) | {"by slip": by_slip}


def _errors(squares: dict[str, np.ndarray], poses: np.ndarray, inside: np.ndarray) -> Json:
    """Of squared errors px^2 (N,) those `inside` (N,)."""
    squares = {name: values[inside] for name, values in squares.items()}
    means = redrawn_means(squares, poses[inside], SEED)
    rms = {name: float(np.sqrt(values.mean())) for name, values in squares.items()}
    drawn = {name: {"rms_px": rms[name], "interval": interval(np.sqrt(means[name]))} for name in rms}
    ratios = np.sqrt(means[EXCHANGED] / means[OWN])
    ratio = {"ratio": rms[EXCHANGED] / rms[OWN], "ratio interval": interval(ratios)}
    return {"slides": int(inside.sum()), "drawn": drawn, **ratio}
