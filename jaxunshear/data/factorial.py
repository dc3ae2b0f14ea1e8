"""Read slides that several poses share, so that pose and slide can be combined freely.

Only a simulator can give "the pose of this contact, after the slide of that one". The sets are made
with `paired.poses_a_slide` of two or more.

>>> reader = FactorialReader(settings, folder, metadata)
>>> fields = ("sheared_pins", "other_pins", "swapped_pins")
>>> batch = next(reader.train_batches(64, seed, 0.0, fields)(0))

`other_pins` are of another pose after another slide; `swapped_pins` of the example's own pose after
that other slide; `other` and `swapped` are the images of the two. Where a contact was dropped, both
are the example's own.
"""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import PairedData
from jaxunshear.data.pose_groups import sample_next
from jaxunshear.data.reader import Batch, SetReader
from jaxunshear.data.sampling import find_slide_leaders

SHEARED_PINS = "sheared_pins"  # the field that both are taken from
OTHER, SWAPPED = "other_pins", "swapped_pins"
IMAGE, OTHER_IMAGE, SWAPPED_IMAGE = "sheared", "other", "swapped"  # likewise
PARTNERS = {OTHER: SHEARED_PINS, SWAPPED: SHEARED_PINS, OTHER_IMAGE: IMAGE, SWAPPED_IMAGE: IMAGE}


class Partners(NamedTuple):
    """The partners of B rows."""

    other: np.ndarray  # (B,) rows of another pose after another slide
    swapped: np.ndarray  # (B,) rows of the same pose after that other slide


class SharedSlides(NamedTuple):
    """Which rows of a split share a pose, and which a slide."""

    group: np.ndarray  # (N,) of poses that share their slides
    place: np.ndarray  # (N,) of the pose in its group
    slide: np.ndarray  # (N,)
    row: np.ndarray  # (groups, places, slides), -1 where there is none
    places: np.ndarray  # (groups,) how many poses each has

    def sample_partners(self, rows: np.ndarray, generator: np.random.Generator) -> Partners:
        """Sample partners for rows (B,)."""
        group, place, slide = self.group[rows], self.place[rows], self.slide[rows]
        other_place = sample_next(place, self.places[group], generator)
        other_slide = sample_next(slide, np.full(len(rows), self.row.shape[2]), generator)
        other = self.row[group, other_place, other_slide]
        swapped = self.row[group, place, other_slide]
        is_complete = (other >= 0) & (swapped >= 0)
        return Partners(np.where(is_complete, other, rows), np.where(is_complete, swapped, rows))


def index_shared_slides(rows: Batch, settings: PairedData) -> SharedSlides:
    """Index the slides that rows of a split share, by `stimulus`, `pose_id` and `slide_id` (N,)."""
    leaders = np.stack([find_slide_leaders(settings, name) for name in settings.names])
    leader = leaders[rows["stimulus"], rows["pose_id"]]
    _, group = np.unique(np.stack([rows["stimulus"], leader], axis=1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    pose, first = np.unique(np.stack([group, rows["pose_id"]], axis=1), axis=0, return_inverse=True)
    starts = np.searchsorted(pose[:, 0], np.arange(group.max(initial=-1) + 1))
    place = first.reshape(-1) - starts[group]
    places = np.bincount(pose[:, 0])
    row = np.full((len(places), settings.poses_a_slide, settings.slides), -1)
    row[group, place, rows["slide_id"]] = np.arange(len(group))
    return SharedSlides(group, place, rows["slide_id"], row, places)


class FactorialReader(SetReader):
    """Reads a set with the fields of partners.

    Partners are drawn by seed and step in training, and once and for all in evaluation.
    """

    def __init__(self, settings: PairedData, folder: Path, metadata: dict) -> None:
        super().__init__(settings, folder, metadata)
        self.shared = functools.cache(lambda split: index_shared_slides(self.rows(split), settings))

    def take(self, name: str, rows: np.ndarray, fields: Sequence[str]) -> Batch:
        stored = super().take(name, rows, _select_stored_fields(fields))
        return stored | self._read_partners(name, rows, fields)

    def sample_partners(self, split: str, rows: np.ndarray, *step: int) -> Partners:
        """Sample the partners of rows (B,): for evaluation, or for a training's seed and step."""
        return self.shared(split).sample_partners(rows, np.random.default_rng(step or 0))

    def _make_training_batch(
        self, here: np.ndarray, taps: np.ndarray, fields: Sequence[str], seed: tuple[int, ...]
    ) -> Batch:
        stored = super()._make_training_batch(here, taps, _select_stored_fields(fields), seed)
        return stored | self._read_partners("train", here, fields, *seed)

    def _read_partners(
        self, split: str, rows: np.ndarray, fields: Sequence[str], *step: int
    ) -> Batch:
        partner_fields = [name for name in fields if name in PARTNERS]
        if not partner_fields:
            return {}
        partners, stored = self.sample_partners(split, rows, *step), self.rows(split)
        batch: Batch = {}
        for name in partner_fields:
            source = partners.other if name in (OTHER, OTHER_IMAGE) else partners.swapped
            batch[name] = stored[PARTNERS[name]][source]
        return self._unpack_images(batch)


def _select_stored_fields(fields: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in fields if name not in PARTNERS)
