"""The same test contacts as each run unshears them: the first run's montage, and the other runs' networks on its images."""

from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxunshear.compare.runs import Run, same_inputs, same_test
from jaxunshear.dataset.preparing import to_found, to_image
from jaxunshear.dataset.recorded_reading import frame_from
from jaxunshear.errors import UserError
from jaxunshear.evaluation.networks import load
from jaxunshear.folders import load_settings
from jaxunshear.image.framing import undeformed
from jaxunshear.image.lattice import make_lattice
from jaxunshear.image.png import eight_bit
from jaxunshear.image.tracking import followed
from jaxunshear.metrics import ms_ssim, scales_that_fit
from jaxunshear.report import montage, words
from jaxunshear.settings.experiment import Experiment, over_pins, recorded_of, simulated_of
from jaxunshear.storage import read_json
from jaxunshear.training.examples import FRAME, Pins, pins_of

VIEW = ("camera", "preprocess", "digest")  # settings of `paired` that decide how a contact appears


class Contacts(NamedTuple):
    """M contacts that are typical of the first run's test, one of each shape."""

    said: list[list[str]]  # what each is
    sheared: np.ndarray  # (M, S, S) uint8, and so are the others
    tap: np.ndarray
    unsheared: list[np.ndarray | None]  # by run; None where a run has none to show
    likeness: list[np.ndarray | None]  # to the tap, (M,)
    notes: list[str]


def contacts(runs: list[Run]) -> Contacts | None:
    """None where the first run unshears nothing, or shows nothing. Raises UserError where its montage is damaged."""
    first = runs[0]
    if first.shown == "sheared" or not (first.folder / "montage.npz").is_file():
        return None
    shown = montage.read(first.folder / "montage.npz")
    rows, _ = montage.typical(shown)
    kept = {name: values[rows] for name, values in shown.items()}
    images: list[np.ndarray | None] = [kept[first.shown]]
    notes = []
    for run in runs[1:]:
        try:
            images.append(_unsheared(run, first, kept["sheared"]))
        except UserError as error:
            images.append(None)
            notes.append(f"no images of {run.name}: {error}")
    said = [montage.described(shown, row, montage.terms(first.results)) for row in rows]
    likeness = [None if image is None else _likeness(image, kept["tap"]) for image in images]
    return Contacts(said, kept["sheared"], kept["tap"], images, likeness, notes)


def _likeness(images: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """MS-SSIM (M,) of uint8 images (M, S, S); NaN of blank ones."""
    one, other = (jnp.asarray(each[..., None], jnp.float32) / 255 for each in (images, taps))
    return np.where(images.any(axis=(1, 2)), ms_ssim(one, other, scales_that_fit(images.shape[1])), np.nan)


def _unsheared(run: Run, first: Run, sheared: np.ndarray) -> np.ndarray:
    """(M, S, S) uint8 of what `run` makes of the first run's sheared images; blank where their pins are not found for sure."""
    if run.shown == "sheared":
        raise UserError("it has no network that unshears")
    if not same_test(run, first) or _view(run) != _view(first):
        raise UserError("it was scored on other contacts, or sees them otherwise")
    if words.over_pins(first.results) and not same_inputs(run, first):
        raise UserError("it reads images, of which the first run has the pins alone")
    experiment = load_settings(run.folder)
    if not over_pins(experiment):
        network = load(run.folder, (run.shown,), None, experiment.train.precision)
        outputs, _ = network(np.zeros_like(sheared)[..., None], sheared[..., None])
        return eight_bit(np.asarray(outputs.images[run.shown])[..., 0])
    pins, sure, frame = _pins(experiment, run.folder, sheared)
    outputs, _ = load(run.folder, (run.shown,), pins=frame)(pins, pins)
    drawn = np.asarray(outputs.images[run.shown])[..., 0]
    return eight_bit(np.where(sure[:, None, None], drawn, 0))


def _view(run: Run) -> dict[str, Any]:
    settings = run.results["settings"]
    return {"sensor": settings["sensor"]} | {name: settings["paired"].get(name) for name in VIEW}


def _pins(experiment: Experiment, folder: Path, images: np.ndarray) -> tuple[np.ndarray, np.ndarray, Pins]:
    """Pins (M, P, 2) px found in images, whether each image's are sure (M,), and what networks over pins must know."""
    binary = (images > 127).astype(np.uint8) * np.uint8(255)
    if recorded_of(experiment):
        stored = read_json(folder / FRAME)
        frame = frame_from(stored)
        motion, sure = followed(lattice := make_lattice(to_found(frame, frame.place), frame.shell), binary, alone=True)
        return to_image(frame, lattice.place + motion).astype(np.float32), sure, pins_of(stored)
    paired, _ = simulated_of(experiment, "this")
    lattice = undeformed(experiment.sensor, paired.camera, paired.preprocess)
    motion, sure = followed(lattice, binary, alone=True)
    size = paired.preprocess.size
    radius = experiment.sensor.pin_radius_mm * size / paired.camera.mm_across
    return (lattice.place + motion).astype(np.float32), sure, Pins(lattice.place, radius, size)
