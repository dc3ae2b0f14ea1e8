"""The same test contacts as each run unshears them: the first run's montage, and the other runs' networks on its images.

Networks over pins need what no montage holds: of them those contacts are shown that all evaluations kept.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxunshear.compare.runs import Run, same_inputs, same_test
from jaxunshear.errors import UserError
from jaxunshear.evaluation.networks import load
from jaxunshear.image.png import eight_bit
from jaxunshear.metrics import ms_ssim, scales_that_fit
from jaxunshear.report import montage, words

VIEW = ("camera", "preprocess", "digest")  # settings of `paired` that decide how a contact appears


class Contacts(NamedTuple):
    """M contacts that are typical of the first run's test, one of each shape."""

    said: list[list[str]]  # what each is
    sheared: np.ndarray  # (M, S, S) uint8, and so are the others
    tap: np.ndarray
    truth: str  # what the tap is: of a recorded slide, a partner
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
    if words.over_pins(first.results):
        rows = [
            row for row in range(len(shown["tap"])) if all(_kept(run, shown["sheared"][row]) for run in runs)
        ] or rows
    kept = {name: values[rows] for name, values in shown.items()}
    images: list[np.ndarray | None] = [kept[first.shown]]
    notes = []
    for run in runs[1:]:
        try:
            images.append(unsheared_by(run, first, kept["sheared"]))
        except UserError as error:
            images.append(None)
            notes.append(f"no images of {run.name}: {error}")
    terms = montage.terms(first.results)
    said = [montage.described(shown, row, terms) for row in rows]
    likeness = [None if image is None else _likeness(image, kept["tap"]) for image in images]
    return Contacts(said, kept["sheared"], kept["tap"], terms.heads[2], images, likeness, notes)


def _likeness(images: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """MS-SSIM (M,) of uint8 images (M, S, S); NaN of blank ones."""
    one, other = (jnp.asarray(each[..., None], jnp.float32) / 255 for each in (images, taps))
    return np.where(images.any(axis=(1, 2)), ms_ssim(one, other, scales_that_fit(images.shape[1])), np.nan)


def unsheared_by(run: Run, first: Run, sheared: np.ndarray) -> np.ndarray:
    """(M, S, S) uint8 of what `run` makes of the first run's sheared images; blank where none is kept."""
    if run.shown == "sheared":
        raise UserError("it has no network that unshears")
    if not same_test(run, first) or _view(run) != _view(first):
        raise UserError("it was scored on other contacts, or sees them otherwise")
    if words.over_pins(run.results):
        return _stored(run, sheared)
    if not same_inputs(run, first):
        raise UserError("it reads images, of which the first run has the pins alone")
    network = load(run.folder, (run.shown,))
    outputs, _ = network(np.zeros_like(sheared)[..., None], sheared[..., None])
    return eight_bit(np.asarray(outputs.images[run.shown])[..., 0])


def _stored(run: Run, sheared: np.ndarray) -> np.ndarray:
    """Of a run over pins, whose montage holds a few contacts without their pins: those of them that are asked for."""
    found = [place[0] if (place := _kept(run, image)) else np.zeros_like(image) for image in sheared]
    if not np.any(found):
        raise UserError("it reads pins, and its evaluation kept images of other contacts")
    return np.stack(found)


def _kept(run: Run, sheared: np.ndarray) -> list[np.ndarray]:
    """What the run's montage holds as unsheared of this sheared image (S, S), if it does."""
    if not (run.folder / "montage.npz").is_file():
        return []
    shown = montage.read(run.folder / "montage.npz")
    same = [row for row, image in enumerate(shown["sheared"]) if np.array_equal(image, sheared)]
    return [shown[run.shown][row] for row in same[:1]]


def _view(run: Run) -> dict[str, object]:
    settings = run.results.settings
    return {"sensor": settings["sensor"]} | {name: settings["paired"].get(name) for name in VIEW}
