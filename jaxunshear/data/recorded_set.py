"""Read a recorded set as networks learn from it: its taps, and its slides each with a partner.

stored = RecordedSet(settings, open_set(settings, data_dir, sensor))
taps = stored.read_taps()  # Reader of image, pins, pose, ...
pairs = stored.read_pairs(targets, render)  # Reader of canonical, sheared, their pins, pose, ...

How a slide gets its partner is in `pairing`.
"""

from pathlib import Path

import numpy as np

from jaxunshear.config.data import RENDERED_PAIRINGS, Recorded
from jaxunshear.config.splits import SPLITS, hash_text
from jaxunshear.config.targets import (
    Targets,
    list_column_names,
    list_slide_names,
    make_label_targets,
    make_move_targets,
)
from jaxunshear.data import pairing
from jaxunshear.data.chunks import unpack_bits
from jaxunshear.data.pairing import PoseEstimator, SlideSimulator, TapRenderer, make_pose_ids_unique
from jaxunshear.data.reader import Batch, Reader, concatenate_batches
from jaxunshear.data.recorded_contacts import read_test_contacts
from jaxunshear.data.recorded_frames import UnstoredSet, prepare_chunks
from jaxunshear.data.sensor_frame import parse_frame
from jaxunshear.data.stored_sets import SetReader
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.perception.lattice import Lattice, make_lattice

CONTACT_FIELDS = ("pose", "move", "others", "sure", "number", "pose_id", "stimulus")


def read_other_recordings(
    settings: Recorded, frame: Json, folder: Path, targets: tuple[str, ...] = ()
) -> "RecordedSet":
    """Read other recordings of a sensor, all for a test; prepared frames are kept in `folder`.

    `frame` is what the sensor's own frames have in common: the crop and the rest positions.
    Raises UserError if nothing can be read.
    """
    contacts, name = read_test_contacts(settings), settings.slide_folder or settings.tap_folder
    paths = prepare_chunks(contacts, settings, parse_frame(frame), folder, f"read {name}")
    return RecordedSet(settings, UnstoredSet(contacts, paths, frame), targets=targets)


class RecordedSet:
    """Reads taps, slides and pairs from a recorded set.

    `seed` draws which slides are labelled, if not all are; `targets` say what a label is.
    """

    def __init__(
        self,
        settings: Recorded,
        stored: SetReader | UnstoredSet,
        seed: int = 0,
        targets: tuple[str, ...] = (),
    ) -> None:
        self.seed, self._targets = seed, targets
        self.settings, self.stored, self.metadata = settings, stored, stored.metadata
        self.size = settings.preprocess.size

    @property
    def frame(self) -> Json:
        """What the sensor's frames have in common; see `sensor_frame.SensorFrame`."""
        return self.metadata["frame"]

    @property
    def columns(self) -> list[str]:
        """The names of the further columns of the tables, as in `others`."""
        return self.metadata.get("others", [])

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
        others = {name: labels["others"][:, i] for i, name in enumerate(self.columns)}
        return make_label_targets(names, labels["pose"], labels["move"], others)

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
        return Reader(lambda split: make_pose_ids_unique(self.read_labelled_taps(split)), self.size)

    def read_labelled_taps(self, split: str) -> Batch:
        """Read all labelled taps of a split, images at one bit a pixel."""
        rows = self._select(split, is_slide=False)
        return pairing.take_rows(rows, self._has_label(rows))

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
                taps = self.read_labelled_taps(split)
                still = _rename_as_slides(taps | {"move": np.zeros_like(taps["pose"])})
                slides = concatenate_batches([slides, still])
            return make_pose_ids_unique(slides)

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

        The fields of the partner are those of `pairing`. Raises UserError if no slide has one.

        Args:
            targets: What "nearest" compares.
            render: Renders the partners of "rendered", and of test slides of "simulated".
            images: Without them partners are pins alone.
            estimate: Gives training slides without a label a pose; without it they are left out.
            simulate: Gives slides to the taps of all splits but the test, as for "simulated"; each
                is paired with its tap.
        """
        method = self.settings.pairing

        def load(split: str) -> Batch:
            if simulate and split != "test":
                return self._simulate_slides(split, simulate, images)
            slides = self._select_slides(split, estimate, images)
            if method in RENDERED_PAIRINGS:
                assert render is not None
                if not images:
                    return pairing.pair_with_renderings(slides, targets, render)
                taps, warp = self.read_labelled_taps("train"), self._make_image_warper()
                return pairing.pair_with_renderings(slides, targets, render, taps, warp)
            taps = self.read_labelled_taps("train")
            # Held-out slides may take taps of training or of their own split. A test tap among
            # validation partners would let the test choose the checkpoint.
            if split != "train":
                taps = concatenate_batches([taps, self.read_labelled_taps(split)])
            pairs = pairing.pair_with_taps(slides, taps, targets, method)
            if method != "nearest" and not len(pairs["pose"]):
                raise UserError(
                    f"no {split} slide has a tap of its pose_id at its pose: record taps and "
                    "slides of the same poses, or use --paired.pairing rendered"
                )
            return pairs

        return Reader(load, self.size)

    def _select_slides(
        self, split: str, estimate: PoseEstimator | None = None, images: bool = True
    ) -> Batch:
        """Select the slides of a split that have a label, or get one by `estimate`."""
        rows = self._select(split, is_slide=True)
        has_label = self._has_label(rows)
        if split != "test":
            has_label &= self._is_labelled(rows)
        if estimate and split == "train":
            unpacked = unpack_bits(rows["image"][~has_label], self.size) if images else None
            pose = rows["pose"].copy()
            pose[~has_label] = estimate(unpacked, rows["pins"][~has_label])
            return _rename_as_slides(rows | {"pose": pose})
        return _rename_as_slides(pairing.take_rows(rows, has_label))

    def _has_label(self, rows: Batch) -> np.ndarray:
        """Return which contacts (N,) have the labels of all targets, or else a pose."""
        has_pose = np.asarray(np.isfinite(rows["pose"]).all(axis=1))
        names = list_column_names(self._targets)
        if not names:
            return has_pose
        own = [i for i, name in enumerate(self.columns) if name in names]
        has_columns = np.asarray(np.isfinite(rows["others"][:, own]).all(axis=1))
        return has_columns if len(names) == len(self._targets) else has_columns & has_pose

    def _is_labelled(self, rows: Batch) -> np.ndarray:
        """Return which contacts (N,) are in the share whose labels are used.

        It depends on seed and contact, not on the order of the files.
        """
        draws = [hash_text(f"label {self.seed} {n}") / 2**64 for n in rows["number"].tolist()]
        return np.array(draws) < self.settings.labelled

    def _simulate_slides(self, split: str, simulate: SlideSimulator, images: bool) -> Batch:
        """Simulate slides to the taps of a split, each paired with its tap."""
        slides, taps = simulate(split), self.read_labelled_taps(split)
        row, sheared_pins = slides["row"], slides["sheared_pins"]
        batch = {name: taps[name][row] for name in ("pose", "sure", "stimulus")}
        batch |= pairing.make_full_pairs(len(row)) | {
            "sheared_pins": sheared_pins,
            "canonical_pins": taps["pins"][row],
            "move": slides["move"],
            "number": np.arange(len(row), dtype=np.int32),
        }
        if images:
            motion = np.nan_to_num(sheared_pins - batch["canonical_pins"])
            batch["canonical"] = taps["image"][row]
            batch["sheared"] = self._make_image_warper()(batch["canonical"], motion)
        return make_pose_ids_unique(batch)

    def _make_image_warper(self) -> pairing.ImageWarper:
        rest, spacing_px = np.array(self.frame["place_px"]), self.frame["spacing_px"]
        return pairing.make_image_warper(rest, spacing_px, self.size)

    def _select(self, split: str, is_slide: bool) -> Batch:
        rows = self.stored.rows(split)
        stimulus = np.zeros(len(rows["slid"]), np.int32)
        return pairing.take_rows(rows | {"stimulus": stimulus}, rows["slid"] == int(is_slide))


def _rename_as_slides(contacts: Batch) -> Batch:
    batch = {name: contacts[name] for name in CONTACT_FIELDS if name in contacts}
    return batch | {"sheared": contacts["image"], "sheared_pins": contacts["pins"]}
