"""A recorded set as networks learn from it: its taps, and its slides each with a partner.

stored = open_recorded(settings, sensor, data_dir)
taps = stored.taps()                                       # Reader of image, pins, pose, ...
pairs = stored.pairs(targets, render)                      # Reader of canonical, sheared, their pins, pose, move, weight, gap
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxunshear.config.data import RENDERED_PAIRINGS, Recorded
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.splits import SPLITS, hash_text
from jaxunshear.config.targets import (
    Targets,
    list_slide_names,
    make_label_targets,
    make_move_targets,
)
from jaxunshear.data import pairing
from jaxunshear.data.chunks import load_chunk, unpack_bits
from jaxunshear.data.preprocessing import SensorFrame
from jaxunshear.data.reader import Batch, Reader, SetReader, open_set
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.data.recorded_examples import count_contacts
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.perception.lattice import Lattice, make_lattice
from jaxunshear.perception.preprocess import Box, View

TapRenderer = Callable[[np.ndarray], np.ndarray]  # poses (N, 6) -> pins (N, P, 2) px
# images (N, S, S) uint8, or None for those that read pins alone; pins (N, P, 2) px -> poses (N, 6)
PoseEstimator = Callable[[np.ndarray | None, np.ndarray], np.ndarray]
# split -> row (N,) of a labelled tap, sheared_pins (N, P, 2) px and move (N, 6): simulated slides
SlideSimulator = Callable[[str], Batch]


def open_recorded(
    settings: Recorded, sensor: Sensor, data_dir: Path, seed: int = 0
) -> "RecordedSet":
    """`seed` draws which slides are labelled, where not all are. Raises UserError where the set is missing or damaged."""
    return RecordedSet(settings, open_set(settings, data_dir, sensor), seed)


def parse_frame(stored: Json) -> SensorFrame:
    """The inverse of what metadata keep of a sensor's frames."""
    box = Box(*stored["box"]) if stored["box"] else None
    view = View(box, tuple((kind, white) for kind, white in stored["whites"]))
    place, shell = np.array(stored["place_px"]), np.array(stored["shell"])
    return SensorFrame(
        view,
        place,
        shell,
        *(stored[name] for name in ("spacing_px", "radius_px", "size", "pins_px")),
    )


class UnstoredSet:
    """Chunks of prepared frames in the place of a stored set: all of them are its test split."""

    def __init__(self, contacts: RecordedContacts, paths: list[Path], frame: Json) -> None:
        chunks = [load_chunk(path) for path in paths]
        parts = {
            name: np.concatenate([chunk[name] for chunk in chunks])
            for name in ("images", "pins", "sure", "usable", "problem")
        }
        kept = parts["usable"]
        self._test: Batch = {
            "image": parts["images"][kept],
            "pins": parts["pins"][kept].astype(np.float32),
            "sure": parts["sure"][kept].astype(np.int32),
            "slid": contacts.is_slide[kept].astype(np.int32),
            "pose": contacts.pose[kept].astype(np.float32),
            "move": contacts.move[kept].astype(np.float32),
            "pose_id": contacts.pose_id[kept].astype(np.int32),
            "number": np.flatnonzero(kept).astype(np.int32),
        }
        self.metadata: Json = {
            "counts": count_contacts(contacts, kept, parts["sure"], parts["problem"]),
            "frame": frame,
            "pins": {"sure": round(float(parts["sure"][kept].mean()), 6) if kept.any() else 0.0},
            "notes": list(contacts.notes),
        }

    def rows(self, split: str) -> Batch:
        return (
            self._test
            if split == "test"
            else {name: value[:0] for name, value in self._test.items()}
        )


class RecordedSet:
    def __init__(self, settings: Recorded, stored: SetReader | UnstoredSet, seed: int = 0) -> None:
        self.seed = seed
        self.settings, self.stored, self.metadata = settings, stored, stored.metadata
        self.size = settings.preprocess.size

    @property
    def frame(self) -> Json:
        """What the sensor's frames have in common; see `preprocessing.SensorFrame`."""
        return self.metadata["frame"]

    def make_lattice(self) -> Lattice:
        """The untouched pins, px of the prepared image."""
        return make_lattice(np.array(self.frame["place_px"]), np.array(self.frame["shell"]))

    def make_targets(self, wanted: tuple[str, ...]) -> Targets:
        """Targets by the labels of training contacts alone. Raises UserError."""
        labels = self.stored.rows("train")
        if asked := list_slide_names(wanted):
            for split in SPLITS:
                slides = self._slides(split)
                if unknown := np.count_nonzero(~np.isfinite(slides["move"]).all(axis=1)):
                    raise UserError(
                        f"target '{asked[0]}': {unknown} {split} slides have a pose but no label of their slide"
                    )
        return make_label_targets(wanted, labels["pose"], labels["move"])

    def make_slide_targets(self) -> Targets:
        """What training slides vary of their move."""
        rows = self.stored.rows("train")
        labelled = _draw_label_shares(rows["number"], self.seed) < self.settings.labelled
        return make_move_targets(rows["move"][labelled & (rows["slid"] == 1)])

    def count_contacts(self, kind: str, split: str) -> int:
        """Of "taps" or "slides"."""
        return int(self.metadata["counts"][kind][split])

    def read_taps(self) -> Reader:
        """Labelled taps: image, pins, sure, pose, pose_id, stimulus, number. One at each pose of its own."""
        return Reader(lambda split: _number_poses(self.read_labelled_taps(split)), self.size)

    def read_labelled_taps(self, split: str) -> Batch:
        """All of a split, images at one bit a pixel."""
        rows = self._select(split, False)
        return _take_rows(rows, np.isfinite(rows["pose"]).all(axis=1))

    def read_slides(self, simulate: SlideSimulator | None = None, images: bool = True) -> Reader:
        """Labelled slides alone: sheared, sheared_pins, sure, pose, move, pose_id, stimulus, number. Of training and validation slides
        the settings' share; with `simulate` simulated ones in their place, without `images` as pins alone. Where the settings say so,
        the training split has the taps behind its slides."""

        def load(split: str) -> Batch:
            if simulate and split != "test":
                return self._simulate_slides(split, simulate, images)
            slides = self._slides(split)
            if split == "train" and self.settings.direct_taps == "recorded":
                slides = _concatenate([slides, _make_zero_slides(self.read_labelled_taps(split))])
            return _number_poses(slides)

        return Reader(load, self.size)

    def read_pairs(
        self,
        targets: Targets,
        render: TapRenderer | None = None,
        images: bool = True,
        estimate: PoseEstimator | None = None,
        simulate: SlideSimulator | None = None,
    ) -> Reader:
        """The same, each with a partner by the settings' pairing: canonical, canonical_pins; `render` for "rendered". Without `images`
        partners are pins alone. `estimate` gives training slides without a label a pose; without it these are left out. `simulate` for
        "simulated": all slides but the test's are simulated, each paired with the tap it was made from.

        `weight` (B,) is what a pair counts in training, `gap` (B, 6) how far the partner's pose is off. Raises UserError where no slide
        has a partner.
        """

        def load(split: str) -> Batch:
            if simulate and split != "test":
                return self._simulate_slides(split, simulate, images)
            return self._pair_slides(
                split, self._slides(split, estimate, images), targets, render, images
            )

        return Reader(load, self.size)

    def _slides(self, split: str, read: PoseEstimator | None = None, images: bool = True) -> Batch:
        rows = self._select(split, True)
        known = np.isfinite(rows["pose"]).all(axis=1)
        if split != "test":
            known &= _draw_label_shares(rows["number"], self.seed) < self.settings.labelled
        if read and split == "train":
            unpacked = unpack_bits(rows["image"][~known], self.size) if images else None
            pose = rows["pose"].copy()
            pose[~known] = read(unpacked, rows["pins"][~known])
            rows = rows | {"pose": pose}
        else:
            rows = _take_rows(rows, known)
        batch = {
            name: rows[name] for name in ("pose", "move", "sure", "number", "pose_id", "stimulus")
        }
        return batch | {"sheared": rows["image"], "sheared_pins": rows["pins"]}

    def _pair_slides(
        self, split: str, batch: Batch, targets: Targets, render: TapRenderer | None, images: bool
    ) -> Batch:
        way, count = self.settings.pairing, len(batch["pose"])
        if way in RENDERED_PAIRINGS:
            if render is None:
                raise ValueError(f"pairing '{way}' takes a renderer")
            pins = render(batch["pose"]).astype(np.float32)
            partner = {"canonical_pins": pins, "gap": np.zeros((count, 6), np.float32)}
            if images:
                partner["canonical"] = self._render_targets(batch["pose"], pins, targets, render)
            return _number_poses(batch | partner | {"weight": np.ones(count, np.float32)})
        # a tap of another held-out split would let that split choose the checkpoint
        taps = _concatenate(
            [self.read_labelled_taps(each) for each in dict.fromkeys(("train", split))]
        )
        if way == "nearest":
            row, distance = pairing.find_nearest(targets, batch["pose"], taps["pose"])
            weight = pairing.compute_pair_weights(distance)
        else:
            poses = (batch["pose"], batch["pose_id"], taps["pose"], taps["pose_id"])
            row = pairing.match_same_pose(*poses, checked=way == "pose_id")
            batch, row = _take_rows(batch, row >= 0), row[row >= 0]
            if not len(row):
                raise UserError(
                    f"no {split} slide has a tap of its pose_id at its pose: record taps and slides of the same poses, or use "
                    "--paired.pairing rendered"
                )
            weight = np.ones(len(row), np.float32)
        partner = {
            "canonical": taps["image"][row],
            "canonical_pins": taps["pins"][row],
            "gap": pairing.compute_pose_gaps(batch["pose"], taps["pose"][row]).astype(np.float32),
            "weight": weight,
        }
        batch = batch | partner
        return batch if way in ("pose_id", "file") else _number_poses(batch)

    def _simulate_slides(self, split: str, drag: SlideSimulator, images: bool) -> Batch:
        """Simulated slides to taps, each with the tap."""
        slides, taps = drag(split), self.read_labelled_taps(split)
        row, sheared = slides["row"], slides["sheared_pins"]
        batch = {name: taps[name][row] for name in ("pose", "sure", "stimulus")}
        batch |= {
            "sheared_pins": sheared,
            "canonical_pins": taps["pins"][row],
            "move": slides["move"],
        }
        batch |= {
            "weight": np.ones(len(row), np.float32),
            "gap": np.zeros((len(row), 6), np.float32),
        }
        if images:
            motion, taken = np.nan_to_num(sheared - batch["canonical_pins"]), taps["image"][row]
            batch |= {"canonical": taken, "sheared": self._warp_images(taken, motion)}
        return _number_poses(batch | {"number": np.arange(len(row), dtype=np.int32)})

    def _render_targets(
        self, poses: np.ndarray, pins: np.ndarray, targets: Targets, render: TapRenderer
    ) -> np.ndarray:
        """(N, S, S) uint8: of each pose (N, 6) the nearest training tap, its pins moved to where the renderer puts them (N, P, 2).

        Real dots and the real housing, which a PoseNet that learnt from taps knows; dots drawn anew appear foreign to it.
        """
        taps = self.read_labelled_taps("train")
        row, _ = pairing.find_nearest(targets, poses, taps["pose"])
        return self._warp_images(taps["image"][row], pins - render(taps["pose"][row]))

    def _warp_images(self, images: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """(N, S, S) uint8: images at one bit a pixel whose pins have moved by `motion` (N, P, 2) px."""
        spread = pairing.interpolate_over_pixels(
            np.array(self.frame["place_px"]), self.frame["spacing_px"], self.size
        )
        return pairing.warp_images(unpack_bits(images, self.size), motion, spread)

    def _select(self, split: str, slid: bool) -> Batch:
        rows = self.stored.rows(split)
        return _take_rows(
            rows | {"stimulus": np.zeros(len(rows["slid"]), np.int32)}, rows["slid"] == int(slid)
        )


def _take_rows(rows: Batch, kept: np.ndarray | np.bool) -> Batch:
    return {name: value[kept] for name, value in rows.items()}


def _concatenate(parts: list[Batch]) -> Batch:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _make_zero_slides(taps: Batch) -> Batch:
    """Return taps in the form of slides."""
    batch = {name: taps[name] for name in ("pose", "sure", "number", "pose_id", "stimulus")}
    batch |= {"move": np.zeros_like(taps["pose"])}
    return batch | {"sheared": taps["image"], "sheared_pins": taps["pins"]}


def _number_poses(rows: Batch) -> Batch:
    """Each contact a pose of its own: none is paired anew with another's partner."""
    return rows | {"pose_id": rows["number"]}


def _draw_label_shares(number: np.ndarray, seed: int) -> np.ndarray:
    """(N,) in [0, 1) by seed and contact: which labels are used does not depend on the order of the files."""
    return np.array([hash_text(f"label {seed} {n}") / 2**64 for n in number.tolist()])
