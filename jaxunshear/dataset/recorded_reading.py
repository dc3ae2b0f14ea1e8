"""A recorded set as networks learn from it: its taps, and its slides each with a partner.

stored = open_recorded(settings, sensor, data_dir)
taps = stored.taps()                                       # Reader of image, pins, pose, ...
pairs = stored.pairs(targets, render)                      # Reader of canonical, sheared, their pins, pose, move, weight, gap
"""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxunshear.dataset import pairing
from jaxunshear.dataset.chunks import pack, unpack
from jaxunshear.dataset.configs import RECORDED_SET
from jaxunshear.dataset.reading import Batch, Reader, SetReader, open_set
from jaxunshear.dataset.settings import Recorded
from jaxunshear.dataset.shots import SPLITS
from jaxunshear.errors import UserError
from jaxunshear.image.lattice import Lattice, make_lattice
from jaxunshear.image.preprocess import View
from jaxunshear.scene.sensor import Sensor
from jaxunshear.targets import Targets, of_labels

BACKGROUND_FROM = 300  # taps that tell what the housing looks like
Render = Callable[[np.ndarray], np.ndarray]  # poses (N, 6) -> pins (N, P, 2) px


def open_recorded(settings: Recorded, sensor: Sensor, data_dir: Path) -> "RecordedSet":
    """Raises UserError where the set is missing or damaged."""
    return RecordedSet(settings, open_set(RECORDED_SET, settings, data_dir, sensor))


class RecordedSet:
    def __init__(self, settings: Recorded, stored: SetReader) -> None:
        self.settings, self.stored, self.metadata = settings, stored, stored.metadata
        self.size = settings.preprocess.size

    @property
    def frame(self) -> dict[str, Any]:
        """What the sensor's frames have in common; see `preparing.Frame`."""
        return self.metadata["frame"]

    def lattice(self) -> Lattice:
        """The untouched pins, px of the prepared image."""
        return make_lattice(np.array(self.frame["place_px"]), np.array(self.frame["shell"]))

    def view(self) -> View:
        whites = tuple((kind, white) for kind, white in self.frame["whites"])
        return View(tuple(self.frame["box"]) if self.frame["box"] else None, whites)

    def targets(self, wanted: tuple[str, ...]) -> Targets:
        """Pose targets by the labels of training contacts alone. Raises UserError."""
        return of_labels(wanted, self.stored.rows("train")["pose"])

    def count(self, kind: str, split: str) -> int:
        """Of "taps" or "slides"."""
        return int(self.metadata["counts"][kind][split])

    def taps(self) -> Reader:
        """Labelled taps: image, pins, sure, pose, pose_id, stimulus, number. One at each pose of its own."""

        def load(split: str) -> Batch:
            rows = self._of(split, False)
            return _numbered(_taken(rows, np.isfinite(rows["pose"]).all(axis=1)))

        return Reader(load, self.size)

    def slides(self) -> Reader:
        """Labelled slides alone: sheared, sheared_pins, sure, pose, move, pose_id, stimulus, number. Of training and validation slides
        the settings' share."""
        return Reader(lambda split: _numbered(self._slides(split)), self.size)

    def pairs(self, targets: Targets, render: Render | None = None) -> Reader:
        """The same, each with a partner by the settings' pairing: canonical, canonical_pins; `render` for "rendered".

        `weight` (B,) is what a pair counts in training, `gap` (B, 6) how far the partner's pose is off. Raises UserError where no slide
        has a partner.
        """
        return Reader(lambda split: self._paired(split, self._slides(split), targets, render), self.size)

    def _slides(self, split: str) -> Batch:
        rows = self._of(split, True)
        kept = np.isfinite(rows["pose"]).all(axis=1)
        if split != "test":
            kept &= _share(rows["number"], self.settings.seed) < self.settings.labelled
        rows = _taken(rows, kept)
        batch = {name: rows[name] for name in ("pose", "move", "sure", "number", "pose_id", "stimulus")}
        return batch | {"sheared": rows["image"], "sheared_pins": rows["pins"]}

    def _paired(self, split: str, batch: Batch, targets: Targets, render: Render | None) -> Batch:
        way, count = self.settings.pairing, len(batch["pose"])
        if way == "rendered":
            if render is None:
                raise ValueError("pairing 'rendered' takes a renderer")
            pins = render(batch["pose"]).astype(np.float32)
            images = pairing.drawn(pins, self.frame["radius_px"], self._background())
            partner = {"canonical": pack(images), "canonical_pins": pins, "gap": np.zeros((count, 6), np.float32)}
            return _numbered(batch | partner | {"weight": np.ones(count, np.float32)})
        taps = self._of(split, False) if split == "train" else _concatenated([self._of(s, False) for s in SPLITS])
        taps = _taken(taps, np.isfinite(taps["pose"]).all(axis=1))
        if way == "nearest":
            row, distance = pairing.nearest(targets, batch["pose"], taps["pose"])
            weight = pairing.weights_of(distance)
        else:
            poses = (batch["pose"], batch["pose_id"], taps["pose"], taps["pose_id"])
            row = pairing.same_pose(*poses, checked=way == "pose_id")
            batch, row = _taken(batch, row >= 0), row[row >= 0]
            if not len(row):
                raise UserError(
                    f"no {split} slide has a tap of its pose_id at its pose: record taps and slides of the same poses, or use "
                    "--paired.pairing rendered"
                )
            weight = np.ones(len(row), np.float32)
        partner = {
            "canonical": taps["image"][row],
            "canonical_pins": taps["pins"][row],
            "gap": pairing.gaps(batch["pose"], taps["pose"][row]).astype(np.float32),
            "weight": weight,
        }
        batch = batch | partner
        return batch if way in ("pose_id", "file") else _numbered(batch)

    def _of(self, split: str, slid: bool) -> Batch:
        rows = self.stored.rows(split)
        return _taken(rows | {"stimulus": np.zeros(len(rows["slid"]), np.int32)}, rows["slid"] == int(slid))

    def _background(self) -> np.ndarray:
        rows = self._of("train", False)["image"]
        chosen = rows[np.unique(np.linspace(0, len(rows) - 1, min(BACKGROUND_FROM, len(rows))).round().astype(int))]
        return pairing.background_of(
            unpack(chosen, self.size), np.array(self.frame["place_px"]), self.frame["spacing_px"]
        )


def _taken(rows: Batch, kept: Any) -> Batch:
    return {name: value[kept] for name, value in rows.items()}


def _concatenated(parts: list[Batch]) -> Batch:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _numbered(rows: Batch) -> Batch:
    """Each contact a pose of its own: none is paired anew with another's partner."""
    return rows | {"pose_id": rows["number"]}


def _share(number: np.ndarray, seed: int) -> np.ndarray:
    """(N,) in [0, 1) by seed and contact: which labels are used does not depend on the order of the files."""
    hashes = (hashlib.blake2b(f"label {seed} {n}".encode(), digest_size=8).digest() for n in number.tolist())
    return np.array([int.from_bytes(each, "big") / 2**64 for each in hashes])
