"""Read a recorded set as networks learn from it: its taps, and its slides each with a partner.

stored = RecordedSet(settings, open_set(settings, data_dir, sensor))
taps = stored.read_taps()  # Reader of image, pins, pose, ...
pairs = stored.read_pairs(targets, render)  # Reader of canonical, sheared, their pins, pose, ...
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxunshear.config.data import RENDERED_PAIRINGS, Recorded
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
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.data.recorded_examples import count_contacts
from jaxunshear.data.stored_sets import SetReader
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.perception.lattice import Lattice, make_lattice
from jaxunshear.perception.preprocess import Box, View

TapRenderer = Callable[[np.ndarray], np.ndarray]  # poses (N, 6) -> pins (N, P, 2) px
# images (N, S, S) uint8, or None if the estimator takes pins; pins (N, P, 2) px -> poses (N, 6)
PoseEstimator = Callable[[np.ndarray | None, np.ndarray], np.ndarray]
# split -> row (N,) of a labelled tap, sheared_pins (N, P, 2) px and move (N, 6): simulated slides
SlideSimulator = Callable[[str], Batch]

CONTACT_FIELDS = ("pose", "move", "sure", "number", "pose_id", "stimulus")


def parse_frame(stored: Json) -> SensorFrame:
    """Parse what metadata keep of a sensor's frames."""
    whites = tuple((kind, white) for kind, white in stored["whites"])
    return SensorFrame(
        view=View(Box(*stored["box"]) if stored["box"] else None, whites),
        rest=np.array(stored["place_px"]),
        ring=np.array(stored["shell"]),
        spacing_px=stored["spacing_px"],
        radius_px=stored["radius_px"],
        size=stored["size"],
        pins_px=stored["pins_px"],
    )


class UnstoredSet:
    """Holds chunks of prepared frames in the place of a stored set, all in its test split."""

    def __init__(self, contacts: RecordedContacts, paths: list[Path], frame: Json) -> None:
        chunks = [load_chunk(path) for path in paths]

        def join(name: str) -> np.ndarray:
            return np.concatenate([chunk[name] for chunk in chunks])

        usable, identified = join("usable"), join("sure")
        self._test: Batch = {
            "image": join("images")[usable],
            "pins": join("pins")[usable].astype(np.float32),
            "sure": identified[usable].astype(np.int32),
            "slid": contacts.is_slide[usable].astype(np.int32),
            "pose": contacts.pose[usable].astype(np.float32),
            "move": contacts.move[usable].astype(np.float32),
            "pose_id": contacts.pose_id[usable].astype(np.int32),
            "number": np.flatnonzero(usable).astype(np.int32),
        }
        share = round(float(identified[usable].mean()), 6) if usable.any() else 0.0
        self.metadata: Json = {
            "counts": count_contacts(contacts, usable, identified, join("problem")),
            "frame": frame,
            "pins": {"sure": share},
            "notes": list(contacts.notes),
        }

    def rows(self, split: str) -> Batch:
        """Return the rows of a split by field: none except for the test."""
        return self._test if split == "test" else _take_rows(self._test, np.s_[:0])


class RecordedSet:
    """Reads taps, slides and pairs from a recorded set.

    `seed` draws which slides are labelled, if not all are.
    """

    def __init__(self, settings: Recorded, stored: SetReader | UnstoredSet, seed: int = 0) -> None:
        self.seed = seed
        self.settings, self.stored, self.metadata = settings, stored, stored.metadata
        self.size = settings.preprocess.size

    @property
    def frame(self) -> Json:
        """What the sensor's frames have in common; see `preprocessing.SensorFrame`."""
        return self.metadata["frame"]

    def make_lattice(self) -> Lattice:
        """Make the lattice, px of the prepared image."""
        return make_lattice(np.array(self.frame["place_px"]), np.array(self.frame["shell"]))

    def make_targets(self, names: tuple[str, ...]) -> Targets:
        """Make the targets of these names by the labels of training contacts.

        Raises UserError if a slide lacks the label of a target.
        """
        slide_names = list_slide_names(names)
        for split in SPLITS if slide_names else ():
            move = self._select_slides(split)["move"]
            unlabelled = np.count_nonzero(~np.isfinite(move).all(axis=1))
            if unlabelled:
                raise UserError(
                    f"target '{slide_names[0]}': {unlabelled} {split} slides have a pose "
                    "but no label of their slide"
                )
        labels = self.stored.rows("train")
        return make_label_targets(names, labels["pose"], labels["move"])

    def make_slide_targets(self) -> Targets:
        """Make the targets of what varies in the moves of training slides."""
        rows = self.stored.rows("train")
        return make_move_targets(rows["move"][self._is_labelled(rows) & (rows["slid"] == 1)])

    def count_contacts(self, kind: str, split: str) -> int:
        """Return the number of "taps" or "slides" of a split."""
        return int(self.metadata["counts"][kind][split])

    def read_taps(self) -> Reader:
        """Read labelled taps: image, pins, sure, pose, pose_id, stimulus, number.

        Each has a pose number of its own.
        """
        return Reader(lambda split: _number_poses(self.read_labelled_taps(split)), self.size)

    def read_labelled_taps(self, split: str) -> Batch:
        """Read all labelled taps of a split, images at one bit a pixel."""
        rows = self._select(split, is_slide=False)
        return _take_rows(rows, np.isfinite(rows["pose"]).all(axis=1))

    def read_slides(self, simulate: SlideSimulator | None = None, images: bool = True) -> Reader:
        """Read labelled slides without partners.

        The fields are sheared, sheared_pins, sure, pose, move, pose_id, stimulus and number. Of
        training and validation slides there is the settings' share; with `simulate` simulated ones
        take their place, without `images` as pins alone. If the settings say so, the training split
        has the taps behind its slides.
        """

        def load(split: str) -> Batch:
            if simulate and split != "test":
                return self._simulate_slides(split, simulate, images)
            slides = self._select_slides(split)
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
        """Read labelled slides, each with a partner by the settings' pairing.

        The further fields are canonical and canonical_pins of the partner, `weight` (B,), what a
        pair counts in training, and `gap` (B, 6), the difference of the partner's pose. Raises
        UserError if no slide has a partner.

        Args:
            targets: What "nearest" compares.
            render: Renders the partners of "rendered".
            images: Without them partners are pins alone.
            estimate: Gives training slides without a label a pose; without it they are left out.
            simulate: For "simulated", all slides but the test's are simulated, each paired with the
                tap it was made from.
        """

        def load(split: str) -> Batch:
            if simulate and split != "test":
                return self._simulate_slides(split, simulate, images)
            slides = self._select_slides(split, estimate, images)
            if self.settings.pairing in RENDERED_PAIRINGS:
                return self._pair_with_rendered(slides, targets, render, images)
            return self._pair_with_taps(split, slides, targets)

        return Reader(load, self.size)

    def _select_slides(
        self, split: str, estimate: PoseEstimator | None = None, images: bool = True
    ) -> Batch:
        """Select the slides of a split that have a label, or get one by `estimate`."""
        rows = self._select(split, is_slide=True)
        has_label = np.isfinite(rows["pose"]).all(axis=1)
        if split != "test":
            has_label &= self._is_labelled(rows)
        if estimate and split == "train":
            unpacked = unpack_bits(rows["image"][~has_label], self.size) if images else None
            pose = rows["pose"].copy()
            pose[~has_label] = estimate(unpacked, rows["pins"][~has_label])
            rows = rows | {"pose": pose}
        else:
            rows = _take_rows(rows, has_label)
        batch = {name: rows[name] for name in CONTACT_FIELDS}
        return batch | {"sheared": rows["image"], "sheared_pins": rows["pins"]}

    def _is_labelled(self, rows: Batch) -> np.ndarray:
        """Return which contacts (N,) are in the share whose labels are used.

        It depends on seed and contact, not on the order of the files.
        """
        draws = [hash_text(f"label {self.seed} {n}") / 2**64 for n in rows["number"].tolist()]
        return np.array(draws) < self.settings.labelled

    def _pair_with_rendered(
        self, slides: Batch, targets: Targets, render: TapRenderer | None, images: bool
    ) -> Batch:
        count = len(slides["pose"])
        if render is None:
            raise ValueError(f"pairing '{self.settings.pairing}' takes a renderer")
        pins = render(slides["pose"]).astype(np.float32)
        partner = {"canonical_pins": pins, "gap": np.zeros((count, 6), np.float32)}
        if images:
            partner["canonical"] = self._render_targets(slides["pose"], pins, targets, render)
        return _number_poses(slides | partner | {"weight": np.ones(count, np.float32)})

    def _pair_with_taps(self, split: str, slides: Batch, targets: Targets) -> Batch:
        pairing_name = self.settings.pairing
        # a tap of another held-out split would let that split choose the checkpoint
        splits = dict.fromkeys(("train", split))
        taps = _concatenate([self.read_labelled_taps(each) for each in splits])
        if pairing_name == "nearest":
            row, distance = pairing.find_nearest(targets, slides["pose"], taps["pose"])
            weight = pairing.compute_pair_weights(distance)
        else:
            row = pairing.match_same_pose(
                slides["pose"],
                slides["pose_id"],
                taps["pose"],
                taps["pose_id"],
                checked=pairing_name == "pose_id",
            )
            slides, row = _take_rows(slides, row >= 0), row[row >= 0]
            if not len(row):
                raise UserError(
                    f"no {split} slide has a tap of its pose_id at its pose: record taps and "
                    "slides of the same poses, or use --paired.pairing rendered"
                )
            weight = np.ones(len(row), np.float32)
        gap = pairing.compute_pose_gaps(slides["pose"], taps["pose"][row]).astype(np.float32)
        pairs = slides | {
            "canonical": taps["image"][row],
            "canonical_pins": taps["pins"][row],
            "gap": gap,
            "weight": weight,
        }
        return pairs if pairing_name in ("pose_id", "file") else _number_poses(pairs)

    def _simulate_slides(self, split: str, simulate: SlideSimulator, images: bool) -> Batch:
        """Simulate slides to the taps of a split, each paired with its tap."""
        slides, taps = simulate(split), self.read_labelled_taps(split)
        row, sheared_pins = slides["row"], slides["sheared_pins"]
        count = len(row)
        batch = {name: taps[name][row] for name in ("pose", "sure", "stimulus")}
        batch |= {
            "sheared_pins": sheared_pins,
            "canonical_pins": taps["pins"][row],
            "move": slides["move"],
            "weight": np.ones(count, np.float32),
            "gap": np.zeros((count, 6), np.float32),
        }
        if images:
            motion = np.nan_to_num(sheared_pins - batch["canonical_pins"])
            batch["canonical"] = taps["image"][row]
            batch["sheared"] = self._warp_images(batch["canonical"], motion)
        return _number_poses(batch | {"number": np.arange(count, dtype=np.int32)})

    def _render_targets(
        self, poses: np.ndarray, pins: np.ndarray, targets: Targets, render: TapRenderer
    ) -> np.ndarray:
        """Render images (N, S, S) uint8 of taps at poses (N, 6), with pins (N, P, 2) px.

        Each is the nearest training tap, its pins moved to where the renderer puts them. So it has
        real dots and the real housing, as the taps that a PoseNet learnt from; to such a network
        dots drawn anew appear foreign.
        """
        taps = self.read_labelled_taps("train")
        row, _ = pairing.find_nearest(targets, poses, taps["pose"])
        return self._warp_images(taps["image"][row], pins - render(taps["pose"][row]))

    def _warp_images(self, images: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Warp images at one bit a pixel so that their pins move by `motion` (N, P, 2) px.

        Returns (N, S, S) uint8.
        """
        rest, spacing_px = np.array(self.frame["place_px"]), self.frame["spacing_px"]
        pixel_motion = pairing.interpolate_over_pixels(rest, spacing_px, self.size)
        return pairing.warp_images(unpack_bits(images, self.size), motion, pixel_motion)

    def _select(self, split: str, is_slide: bool) -> Batch:
        rows = self.stored.rows(split)
        stimulus = np.zeros(len(rows["slid"]), np.int32)
        return _take_rows(rows | {"stimulus": stimulus}, rows["slid"] == int(is_slide))


def _take_rows(rows: Batch, selected: np.ndarray | np.bool | slice) -> Batch:
    return {name: value[selected] for name, value in rows.items()}


def _concatenate(parts: list[Batch]) -> Batch:
    joined: Batch = {}
    for name in parts[0]:
        joined[name] = np.concatenate([part[name] for part in parts])
    return joined


def _make_zero_slides(taps: Batch) -> Batch:
    slides = taps | {"move": np.zeros_like(taps["pose"])}
    batch = {name: slides[name] for name in CONTACT_FIELDS}
    return batch | {"sheared": taps["image"], "sheared_pins": taps["pins"]}


def _number_poses(rows: Batch) -> Batch:
    """Give each contact a pose number of its own: none is paired with another's partner."""
    return rows | {"pose_id": rows["number"]}
