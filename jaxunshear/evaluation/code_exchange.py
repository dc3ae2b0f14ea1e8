"""Exchange codes: reconstruct from the pose code of one slide and the shear code of another.

The reconstruction is compared with the simulated contact of just that pose and that slide. It needs
a data set whose poses share slides, and works over images and pins.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.data.factorial import FactorialReader
from jaxunshear.data.reader import Reader
from jaxunshear.evaluation.bootstrap import compute_interval, number_poses, resample_means
from jaxunshear.evaluation.codes import BATCH, CodeNetwork, load_code_network
from jaxunshear.evaluation.slide_estimation import split_by_slip
from jaxunshear.files import Json
from jaxunshear.metrics.pin_error import compute_half_pitch, measure_pin_error
from jaxunshear.models.modality import IMAGES, PINS
from jaxunshear.perception.png import to_uint8
from jaxunshear.selection import select_evenly
from jaxunshear.training.examples import open_examples

MAX_SLIDES = 2000  # evenly chosen
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

    Errors are root mean squares, in px or in grey of 1. For images also the pins that are detected
    in BATCH of them are compared. `by slip` gives the same for slides whose partner still sticks
    somewhere, and for those whose partner slips everywhere, which hides how far it went.
    None if the poses of the data set share no slides.
    """
    if not isinstance(reader, FactorialReader):
        return None
    contacts = select_evenly(reader.length("test"), MAX_SLIDES)
    partners, targets = reader.sample_partners("test", contacts)
    labels = reader.take("test", contacts, ("stimulus", "pose_id"))
    poses = number_poses(labels["stimulus"], labels["pose_id"])
    exchange = _Exchange(network, reader, contacts, partners, targets)
    squares = exchange.compute_squared_errors()
    changed = targets != contacts
    unit = network.modality.unit
    slips = split_by_slip(reader.take("test", partners, ("stuck", "slipping")))
    by_slip = []
    for part, inside in slips.items():
        if np.any(changed & inside):
            by_slip.append({"part": part, **_summarise(squares, poses, changed & inside, unit)})
    summary = _summarise(squares, poses, changed, unit)
    if network.modality is IMAGES:
        step = max(1, int(changed.sum()) // BATCH)
        some = np.resize(np.flatnonzero(changed)[::step], BATCH)
        true_pins = reader.take("test", targets[some], (PINS.sheared,))[PINS.sheared]
        for name, images in exchange.decode(some).items():
            summary["drawn"][name] |= _measure_pin_errors(images, true_pins)
    return summary | {"by slip": by_slip}


class _Exchange:
    """The codes of test contacts, of partners after other slides, and of targets, rows (N,) each.

    A target has the pose of the contact and the slide of the partner.
    """

    def __init__(
        self,
        network: CodeNetwork,
        reader: Reader,
        contacts: np.ndarray,
        partners: np.ndarray,
        targets: np.ndarray,
    ) -> None:
        self.network = network
        field = network.modality.sheared
        inputs = [reader.take("test", rows, (field,))[field] for rows in (contacts, partners)]
        self.targets = reader.take("test", targets, (field,))[field]
        contact, partner, target = (network.encode(each) for each in (*inputs, self.targets))
        self.codes = {
            EXCHANGED: (contact["z_p"], partner["z_s"]),
            OWN: (target["z_p"], target["z_s"]),
            SHEAR_CODE_KEPT: (contact["z_p"], contact["z_s"]),
        }

    def decode(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Decode some of the N contacts, by the codes that they are decoded from."""
        return {
            name: self.network.decode(z_p[rows], z_s[rows])
            for name, (z_p, z_s) in self.codes.items()
        }

    def compute_squared_errors(self) -> dict[str, np.ndarray]:
        """Compute squared errors (N,) of the reconstructions."""
        modality, count = self.network.modality, len(self.targets)
        errors: dict[str, list[np.ndarray]] = {name: [] for name in self.codes}
        for start in range(0, count, BATCH):
            rows = np.arange(start, start + BATCH) % count
            true = modality.scale(self.targets[rows])
            for name, decoded in self.decode(rows).items():
                errors[name].append(modality.compute_squared_errors(decoded, true))
        return {name: np.concatenate(parts)[:count] for name, parts in errors.items()}


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
    return {
        "slides": int(inside.sum()),
        "drawn": rows,
        "ratio": rms[EXCHANGED] / rms[OWN],
        "ratio interval": compute_interval(np.sqrt(means[EXCHANGED] / means[OWN])),
    }
