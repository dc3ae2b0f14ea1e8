"""Fewer pairs: slides of a share of the poses alone have their tap; taps without a slide, and slides without a tap, may teach beside them.

few = select_few_pairs(examples, share=0.1, seed=0)
batches = few.reader.train_batches(64, 0, 0.0, fields)
batches = add_taps(batches, taps, 32, seed=0)  # {"tap_pins"} (32, P, 2) px beside the pairs
batches = add_same_pose_slides(batches, examples, 32, seed=0)  # {"one_pins", "another_pins"} (32, P, 2) px: two slides to one pose
"""

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from jaxunshear.config.data import PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.splits import hash_text
from jaxunshear.data.pose_groups import group_by_pose
from jaxunshear.data.reader import Batch, Reader, SetReader
from jaxunshear.training.examples import Examples, open_simulated

TAPS, ONE, ANOTHER = "tap_pins", "one_pins", "another_pins"
Batches = Callable[[int], Iterator[Batch]]


def select_few_pairs(examples: Examples, share: float, seed: int) -> Examples:
    """Simulated `examples` whose training and validation slides are those of a `share` of the poses, one at least. An epoch stays as long
    as it is with all pairs."""
    stored = _get_set_reader(examples)

    def load(split: str) -> Batch:
        rows = stored.rows(split)
        kept = (
            slice(None)
            if split == "test"
            else choose_poses(rows["stimulus"], rows["pose_id"], share, seed)
        )
        return {name: value[kept] for name, value in rows.items()}

    return examples._replace(reader=Reader(load, examples.pins.size))


def choose_poses(stimulus: np.ndarray, pose_id: np.ndarray, share: float, seed: int) -> np.ndarray:
    """(N,) whether the pose of each row is drawn. Smaller shares lie within larger ones of the same seed."""
    poses, row = np.unique(np.stack([stimulus, pose_id], axis=1), axis=0, return_inverse=True)
    hashes = [hash_text(f"pair {seed} {s} {p}") for s, p in poses.tolist()]
    drawn = np.zeros(len(poses), bool)
    drawn[
        sorted(range(len(poses)), key=hashes.__getitem__)[: max(1, round(share * len(poses)))]
    ] = True
    return drawn[row.reshape(-1)]


def add_taps(batches: Batches, taps: Reader, count: int, seed: int) -> Batches:
    """The same batches, each with the pins of `count` taps, drawn by seed and step."""
    drawn = taps.train_batches(count, seed, 0.0, ("pins",))

    def from_step(start: int = 0) -> Iterator[Batch]:
        return (
            pairs | {TAPS: alone["pins"]}
            for pairs, alone in zip(batches(start), drawn(start), strict=True)
        )

    return from_step


def add_same_pose_slides(batches: Batches, examples: Examples, count: int, seed: int) -> Batches:
    """The same batches, each with `count` pairs of training slides to one pose, drawn by seed and step; the one slide of a pose twice."""

    def from_step(start: int = 0) -> Iterator[Batch]:
        rows = _get_set_reader(examples).rows("train")
        pins, siblings = rows["sheared_pins"], group_by_pose(rows["stimulus"], rows["pose_id"])
        for step, pairs in zip(itertools.count(start), batches(start)):
            generator = np.random.default_rng((seed, step))
            drawn = generator.integers(len(pins), size=count)
            yield pairs | {ONE: pins[drawn], ANOTHER: pins[siblings.sample_other(drawn, generator)]}

    return from_step


def _get_set_reader(examples: Examples) -> SetReader:
    assert isinstance(examples.reader, SetReader)  # simulated
    return examples.reader


def open_taps(experiment: Experiment, data_dir: Path) -> Reader:
    """The simulated taps without slides. Raises UserError where the set is missing."""
    assert isinstance(experiment.pose, PoseData)
    return open_simulated(experiment.pose, experiment.sensor, data_dir)
