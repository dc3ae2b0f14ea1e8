"""Measures what `jaxunshear adapt` is worth if the camera has moved.

A network over pins learns from contacts of recordings. Then the images of other contacts are moved,
as a camera would that was shifted, turned or brought nearer, and the network is scored on them: as
it is, and adapted by 50 taps that were moved alike. `held` is the share of errors of unsheared
slides that lie within the half-widths of 95 %. The images have to show the sensor as prepared ones
do, without a crop.
"""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from benchmarks.drawn_contacts import (
    TEST,
    draw_contacts,
    format_rows,
    score,
    train,
    write_contacts,
)
from jaxunshear.adapt import adapt
from jaxunshear.angles import rotation_2d
from jaxunshear.config.sensor import Preprocess
from jaxunshear.files import Json
from jaxunshear.results.run import Results

LEARNT = 3000  # taps, and as many slides
TAPS = 50  # of `adapt`
format_table = format_rows


class Move(NamedTuple):
    """How images move: they turn and grow about their middle, and are shifted."""

    shift_px: tuple[float, float] = (0.0, 0.0)  # down and to the right, of a prepared image
    turn_deg: float = 0.0
    scale: float = 1.0


MOVES = {
    "half a pixel": Move((0.3, -0.4)),
    "two pixels": Move((1.2, -1.6)),
    "1 deg": Move(turn_deg=1.0),
    "1 % larger": Move(scale=1.01),
    "all": Move((1.2, -1.6), 1.0, 1.01),
}


def bench_adapt(recordings: Path | None = None, seed: int = 0) -> list[Json]:
    """Return a row for unmoved images, and two for each of MOVES: errors in mm and deg.

    `seed` draws contacts and weights. Raises UserError if recordings hold too few contacts.
    """
    contacts = draw_contacts(recordings, TEST + TAPS + LEARNT, seed)
    with TemporaryDirectory() as name:
        place = Path(name)
        write_contacts(place / "learnt", contacts, slice(TEST + TAPS, TEST + TAPS + LEARNT))
        write_contacts(place / "not moved", contacts, slice(TEST))
        run = train(place, "learnt", seed, "evaluate")
        rows = [_make_row("not moved", score(place, run, "not moved"))]
        for name, move in MOVES.items():
            change, test, taps = partial(move_image, move=move), f"test {name}", f"taps {name}"
            write_contacts(place / test, contacts, slice(TEST), change)
            write_contacts(place / taps, contacts, slice(TEST, TEST + TAPS), change)
            rows.append(_make_row(f"{name}/as it is", score(place, run, test)))
            out = place / "adapted" / str(list(MOVES).index(name))
            adapt(run, place / taps / "tap", out, place / "datasets")
            rows.append(_make_row(f"{name}/adapted", score(place, out, test)))
    return rows


def _make_row(name: str, results: Results) -> Json:
    held = (results.coverage or {})["unsheared"]
    shares = {f"held_{target}": share for target, share in held.items()}
    return {"name": name} | dict(results.pose_mae["unsheared"]) | shares


def move_image(image: np.ndarray, move: Move) -> np.ndarray:
    """Move an image (H, W) or (H, W, C) uint8; its border is repeated beyond it."""
    middle = (np.array(image.shape[:2]) - 1) / 2
    back = rotation_2d(-np.radians(move.turn_deg)) / move.scale
    matrix: np.ndarray = np.eye(image.ndim)
    shift = np.zeros(image.ndim)
    matrix[:2, :2] = back
    shift_px = np.array(move.shift_px) * len(image) / Preprocess().size
    shift[:2] = middle - back @ (middle + shift_px)
    return ndimage.affine_transform(image, matrix, shift, order=1, mode="nearest")
