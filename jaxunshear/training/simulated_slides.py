"""Training slides that nobody recorded: recorded taps, dragged as the simulator says. For `paired.pairing` "simulated".

drag = make_slide_simulator(stored, data_dir)
drag("train")   # {"row", "sheared_pins", "move"}: DRAWN slides to each labelled tap of the split

What the simulator cannot know is drawn widely about what was fitted: friction, how far the pins follow, and how the sensor is turned and
shifted before its camera on another day than that of the taps.
"""

import functools
import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxunshear.angles import rotation_2d
from jaxunshear.calibration.calibration_result import DEFAULT_CALIBRATION
from jaxunshear.calibration.labels import find_depth_axis
from jaxunshear.calibration.simulated_slides import RecordedTaps, fit_label_view, simulate_shear
from jaxunshear.config.configs import compute_config_name
from jaxunshear.config.sensor import Sensor
from jaxunshear.data.chunks import load_chunk
from jaxunshear.data.reader import Batch
from jaxunshear.data.recorded_set import RecordedSet, SlideSimulator
from jaxunshear.errors import UserError
from jaxunshear.files import write_npz
from jaxunshear.progress import Progress
from jaxunshear.training.domain_randomisation import SHIFTED, TURNED_DEG

SLIDE_MM = 5.0  # along both axes of the object's top, within +- this: most slides come to slip
TWIST_DEG = 5.0  # about all three axes
FRICTION = (0.25, 0.55)  # fits to recordings gave .34 to .50
MOTION_FACTOR = (
    0.5,
    2.5,
)  # times the simulated motion; chosen with recorded slides in sight (docs/your-own-recordings.md, 9)
SLIDES_PER_MOTION = 4  # slides to each tap, of one simulated motion
CHUNK = 250  # contacts in a file
VERSION = 1  # raise it whenever the same taps give other slides
# poses (N, 6), slides (N, 6), frictions (N,) -> how far pins are dragged (N, P, 2) px, and (N,) whether that is known
Simulate = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def make_slide_simulator(
    stored: RecordedSet,
    sensor: Sensor,
    data_dir: Path,
    simulate: Simulate | None = None,
    chunk: int = CHUNK,
) -> SlideSimulator:
    """Simulates a slide to each labelled tap of training and validation, beside the data sets, or finds them there; a killed run goes
    on where it stopped. Where `simulate` is not given it is `simulate_shear` of the training taps; files have `chunk` contacts. Raises UserError."""
    place = (
        Path(data_dir).absolute()
        / "simulated_slides"
        / f"{compute_config_name(stored.settings, sensor)}-{_digest()}"
    )
    view = functools.cache(
        lambda: fit_label_view(
            _taps(stored, "train"), stored.make_lattice(), stored.size, DEFAULT_CALIBRATION
        )
    )
    if simulate is None:
        simulate = lambda *slides: simulate_shear(view(), *slides)  # noqa: E731
    motions = {
        split: _motions(stored, split, place / split, simulate, chunk)
        for split in ("train", "validation")
    }

    def drag(split: str) -> Batch:
        rest = np.array(stored.frame["place_px"])
        return _vary_slides(
            _taps(stored, split), *motions[split], rest, stored.frame["spacing_px"], split
        )

    return drag


def _digest() -> str:
    """Of what decides the simulated motions."""
    known = (DEFAULT_CALIBRATION.preset, SLIDE_MM, TWIST_DEG, FRICTION, VERSION)
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()[:8]


def _taps(stored: RecordedSet, split: str) -> RecordedTaps:
    rows = stored.read_labelled_taps(split)
    return RecordedTaps(
        np.where(rows["sure"][:, None, None] == 1, rows["pins"], np.nan), rows["pose"]
    )


def _motions(
    stored: RecordedSet, split: str, folder: Path, simulate: Simulate, chunk: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the split's taps (M,), how far their pins are dragged (M, P, 2) px, and the slides (M, 6)."""
    taps = _taps(stored, split)
    rows = np.flatnonzero(np.isfinite(taps.pins).any((1, 2)))
    parts = [rows[start : start + chunk] for start in range(0, len(rows), chunk)]
    paths = [folder / f"{index:05d}.npz" for index in range(len(parts))]
    missing = [i for i, path in enumerate(paths) if not path.exists()]
    if missing:
        done = len(rows) - sum(len(parts[i]) for i in missing)
        with Progress(
            f"simulate slides ({split})", len(rows), unit="contacts", done=done
        ) as progress:
            for i in missing:
                _write(paths[i], simulate, taps.pose, parts[i])
                progress.advance(len(parts[i]))
    chunks = [load_chunk(path) for path in paths]
    joined = {
        name: np.concatenate([chunk[name] for chunk in chunks])
        for name in ("row", "motion", "move", "fine")
    }
    fine = joined["fine"]
    if not fine.all():
        print(
            f"simulated slides ({split}): {int((~fine).sum())} of {len(fine)} out of reach or not converged, left out"
        )
    if not fine.any():
        raise UserError(
            f"paired.pairing simulated: of {len(fine)} slides none converged: use another pairing"
        )
    return joined["row"][fine], joined["motion"][fine], joined["move"][fine]


def _write(path: Path, simulate: Simulate, pose: np.ndarray, rows: np.ndarray) -> None:
    generator = np.random.default_rng([VERSION, *path.parent.name.encode(), int(path.stem)])
    move = np.zeros((len(rows), 6))
    along = [axis for axis in range(3) if axis != find_depth_axis(pose)]
    move[:, along] = generator.uniform(-1, 1, (len(rows), 2)) * SLIDE_MM
    move[:, 3:] = generator.uniform(-1, 1, (len(rows), 3)) * TWIST_DEG
    motion, fine = simulate(pose[rows], move, generator.uniform(*FRICTION, len(rows)))
    write_npz(path, {"row": rows, "motion": motion, "move": move.astype(np.float32), "fine": fine})


def _vary_slides(
    taps: RecordedTaps,
    row: np.ndarray,
    motion: np.ndarray,
    move: np.ndarray,
    rest: np.ndarray,
    spacing_px: float,
    split: str,
) -> Batch:
    """DRAWN slides of each motion."""
    generator = np.random.default_rng([VERSION, *split.encode()])
    again = np.tile(np.arange(len(row)), SLIDES_PER_MOTION)
    follow = generator.uniform(*MOTION_FACTOR, len(again))[:, None, None]
    angle = np.radians(TURNED_DEG) * generator.standard_normal(len(again))
    moved = (taps.pins[row[again]] - rest + follow * motion[again]) @ rotation_2d(-angle)
    moved += SHIFTED * spacing_px * generator.standard_normal((len(again), 1, 2))
    return {
        "row": row[again],
        "sheared_pins": (rest + moved).astype(np.float32),
        "move": move[again],
    }
