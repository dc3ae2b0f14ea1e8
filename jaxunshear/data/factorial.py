"""Slides that several poses share, so that "the pose of this one, after the slide of that one" can be fetched: what a simulator alone can
give. For sets made with `paired.poses_a_slide` of two or more.

>>> reader = FactorialReader(settings, folder, metadata)
>>> batch = next(reader.train_batches(64, seed, 0.0, ("sheared_pins", "other_pins", "swapped_pins"))(0))

`other_pins` are of another pose after another slide; `swapped_pins` of the example's own pose after that other slide; `other` and `swapped`
the images of the same. Where a contact was dropped, both are the example's own.
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


class SharedSlides(NamedTuple):
    """Which rows of a split share a pose, and which a slide."""

    group: np.ndarray  # (N,) of poses that share their slides
    place: np.ndarray  # (N,) of the pose in its group
    slide: np.ndarray  # (N,)
    row: np.ndarray  # (groups, places, slides), -1 where there is none
    places: np.ndarray  # (groups,) how many poses each has

    def sample_partners(
        self, rows: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """For rows (B,) those, drawn, of another pose after another slide, and of the same pose after that slide: (B,) each."""
        group, place, slide = self.group[rows], self.place[rows], self.slide[rows]
        elsewhere = sample_next(place, self.places[group], generator)
        after = sample_next(slide, np.full(len(rows), self.row.shape[2]), generator)
        other, swapped = self.row[group, elsewhere, after], self.row[group, place, after]
        known = (other >= 0) & (swapped >= 0)
        return np.where(known, other, rows), np.where(known, swapped, rows)


def index_shared_slides(rows: Batch, settings: PairedData) -> SharedSlides:
    """Of a split's rows: `stimulus`, `pose_id`, `slide_id` (N,)."""
    leaders = np.stack([find_slide_leaders(settings, name) for name in settings.names])
    leader = leaders[rows["stimulus"], rows["pose_id"]]
    group = np.unique(np.stack([rows["stimulus"], leader], axis=1), axis=0, return_inverse=True)[
        1
    ].reshape(-1)
    pose, first = np.unique(np.stack([group, rows["pose_id"]], axis=1), axis=0, return_inverse=True)
    starts = np.searchsorted(pose[:, 0], np.arange(group.max(initial=-1) + 1))
    place = first.reshape(-1) - starts[group]
    places = np.bincount(pose[:, 0])
    row = np.full((len(places), settings.poses_a_slide, settings.slides), -1)
    row[group, place, rows["slide_id"]] = np.arange(len(group))
    return SharedSlides(group, place, rows["slide_id"], row, places)


class FactorialReader(SetReader):
    """A `SetReader` with these fields more. Partners are drawn by seed and step; in evaluation once and for all."""

    def __init__(self, settings: PairedData, folder: Path, metadata: dict) -> None:
        super().__init__(settings, folder, metadata)
        self.shared = functools.cache(lambda split: index_shared_slides(self.rows(split), settings))

    def take(self, name: str, rows: np.ndarray, fields: Sequence[str]) -> Batch:
        return super().take(name, rows, _select_stored_fields(fields)) | self._read_partners(
            name, rows, fields
        )

    def sample_partners(
        self, split: str, rows: np.ndarray, *step: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The rows (B,) that others and swapped ones are of: in evaluation, or for a training's seed and step."""
        return self.shared(split).sample_partners(rows, np.random.default_rng(step or 0))

    def _make_training_batch(
        self, here: np.ndarray, taps: np.ndarray, fields: Sequence[str], seed: tuple[int, ...]
    ) -> Batch:
        return super()._make_training_batch(
            here, taps, _select_stored_fields(fields), seed
        ) | self._read_partners("train", here, fields, *seed)

    def _read_partners(
        self, split: str, rows: np.ndarray, fields: Sequence[str], *step: int
    ) -> Batch:
        wanted = [name for name in fields if name in PARTNERS]
        if not wanted:
            return {}
        other, swapped = self.sample_partners(split, rows, *step)
        stored = self.rows(split)
        return self._images(
            {
                name: stored[PARTNERS[name]][other if name in (OTHER, OTHER_IMAGE) else swapped]
                for name in wanted
            }
        )


def _select_stored_fields(fields: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in fields if name not in PARTNERS)
