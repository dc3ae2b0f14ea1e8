"""Simulated slides to recorded taps, for `paired.pairing` "simulated".

simulate_slides = make_slide_simulator(stored, sensor, data_dir)
# {"row", "sheared_pins", "move"}: SLIDES_PER_MOTION slides to each labelled tap of the split
simulate_slides("train")

What the simulator cannot know is drawn from wide ranges about the fitted values: friction, how far
the pins follow, and how the sensor is turned and shifted before its camera on another day than that
of the taps.
"""

import functools
import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.angles import rotation_2d
from jaxunshear.calibration.alignment import LabelView, RecordedTaps, fit_label_view, simulate_shear
from jaxunshear.calibration.labels import find_depth_axis
from jaxunshear.calibration.prediction import DEFAULT_CALIBRATION
from jaxunshear.config.configs import compute_config_name
from jaxunshear.config.sensor import Sensor
from jaxunshear.data.chunks import join_field, load_chunk, write_chunks
from jaxunshear.data.pairing import SlideSimulator
from jaxunshear.data.reader import Batch
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.errors import UserError
from jaxunshear.training.augmentation import SHIFTED, TURNED_DEG

SLIDE_MM = 5.0  # along both axes of the object's top, within +- this: most slides come to slip
TWIST_DEG = 5.0  # about all three axes
FRICTION = (0.25, 0.55)  # fits to recordings gave .34 to .50
# factor of the simulated motion, chosen in view of recorded slides (docs/few-labels.md)
MOTION_FACTOR = (0.5, 2.5)
SLIDES_PER_MOTION = 4  # slides to each tap, of one simulated motion
CHUNK = 250  # contacts in a file
VERSION = 1  # raise it whenever the same taps give other slides
# poses (N, 6), slides (N, 6), frictions (N,) -> motions of pins (N, P, 2) px, validity (N,)
Simulate = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class SlideMotions(NamedTuple):
    """Simulated motions of M taps of a split."""

    number: np.ndarray  # (M,) of the taps
    motion: np.ndarray  # (M, P, 2) px
    move: np.ndarray  # (M, 6) the slides, mm and deg


def make_slide_simulator(
    stored: RecordedSet,
    sensor: Sensor,
    data_dir: Path,
    simulate: Simulate | None = None,
    chunk: int = CHUNK,
) -> SlideSimulator:
    """Simulate a slide to each labelled tap of training and validation, in files in `data_dir`.

    Slides that are in these files already are read, so a killed run resumes. Without `simulate`, it
    is `simulate_shear` of the training taps. Files have `chunk` contacts. Raises UserError.
    """
    name = f"{compute_config_name(stored.settings, sensor)}-{_compute_digest()}"
    folder = Path(data_dir).absolute() / "simulated_slides" / name
    if simulate is None:
        simulate = _make_shear_simulation(stored)
    motions = {
        split: _simulate_motions(stored, split, folder / split, simulate, chunk)
        for split in ("train", "validation")
    }

    def simulate_slides(split: str) -> Batch:
        return _vary_slides(stored, _read_taps(stored, split), motions[split], split)

    return simulate_slides


def _make_shear_simulation(stored: RecordedSet) -> Simulate:
    """Make the simulation of the recorded sensor, which is fitted to the taps at the first call."""

    @functools.cache
    def fit_view() -> LabelView:
        taps, lattice = _read_taps(stored, "train"), stored.make_lattice()
        return fit_label_view(taps, lattice, stored.size, DEFAULT_CALIBRATION)

    return lambda poses, slides, frictions: simulate_shear(fit_view(), poses, slides, frictions)


def _compute_digest() -> str:
    settings = (DEFAULT_CALIBRATION.preset, SLIDE_MM, TWIST_DEG, FRICTION, VERSION)
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]


def _read_taps(stored: RecordedSet, split: str) -> RecordedTaps:
    rows = stored.read_labelled_taps(split)
    is_sure = rows["sure"][:, None, None] == 1
    return RecordedTaps(np.where(is_sure, rows["pins"], np.nan), rows["pose"])


def _simulate_motions(
    stored: RecordedSet, split: str, folder: Path, simulate: Simulate, chunk: int
) -> SlideMotions:
    """Simulate the slides of a split that have no file yet, and read all."""
    taps = _read_taps(stored, split)
    rows = np.flatnonzero(np.isfinite(taps.pins).any((1, 2)))
    parts = [rows[start : start + chunk] for start in range(0, len(rows), chunk)]

    def make(missing: list[int]) -> Iterator[tuple[int, Batch]]:
        for index in missing:
            generator = np.random.default_rng([VERSION, *split.encode(), index])
            yield index, _simulate_chunk(simulate, taps.pose, parts[index], generator)

    paths = write_chunks(folder, parts, make, f"simulate slides ({split})")
    chunks = [load_chunk(path) for path in paths]
    fine = join_field(chunks, "fine")
    if not fine.all():
        print(
            f"simulated slides ({split}): {int((~fine).sum())} of {len(fine)} out of reach or not "
            "converged, left out"
        )
    if not fine.any():
        raise UserError(
            f"paired.pairing simulated: of {len(fine)} slides none converged: use another pairing"
        )
    return SlideMotions(*(join_field(chunks, name)[fine] for name in SlideMotions._fields))


def _simulate_chunk(
    simulate: Simulate, pose: np.ndarray, rows: np.ndarray, generator: np.random.Generator
) -> Batch:
    move = np.zeros((len(rows), 6))
    along = [axis for axis in range(3) if axis != find_depth_axis(pose)]
    move[:, along] = generator.uniform(-1, 1, (len(rows), 2)) * SLIDE_MM
    move[:, 3:] = generator.uniform(-1, 1, (len(rows), 3)) * TWIST_DEG
    motion, fine = simulate(pose[rows], move, generator.uniform(*FRICTION, len(rows)))
    return {"number": rows, "motion": motion, "move": move.astype(np.float32), "fine": fine}


def _vary_slides(
    stored: RecordedSet, taps: RecordedTaps, motions: SlideMotions, split: str
) -> Batch:
    rest, spacing_px = np.array(stored.frame["place_px"]), stored.frame["spacing_px"]
    generator = np.random.default_rng([VERSION, *split.encode()])
    repeats = np.tile(np.arange(len(motions.number)), SLIDES_PER_MOTION)
    row = motions.number[repeats]
    factor = generator.uniform(*MOTION_FACTOR, len(repeats))[:, None, None]
    angle = np.radians(TURNED_DEG) * generator.standard_normal(len(repeats))
    moved = (taps.pins[row] - rest + factor * motions.motion[repeats]) @ rotation_2d(-angle)
    moved += SHIFTED * spacing_px * generator.standard_normal((len(repeats), 1, 2))
    return {
        "row": row,
        "sheared_pins": (rest + moved).astype(np.float32),
        "move": motions.move[repeats],
    }
