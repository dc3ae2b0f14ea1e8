"""Training with few pairs: only slides of a share of the poses have their tap.

Taps without a slide, and slides without a tap, can be added to the batches.

few = select_few_pairs(examples, share=0.1, seed=0)
batches = few.reader.train_batches(64, 0, 0.0, fields)
batches = add_taps(batches, taps, 32, seed=0)  # {"tap_pins"} (32, P, 2) px
# two slides to one pose: {"one_pins", "another_pins"} (32, P, 2) px
batches = add_same_pose_slides(batches, examples, 32, seed=0)
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from jaxunshear.config.network_config import NetworkConfig
from jaxunshear.config.splits import hash_text
from jaxunshear.data.reader import Batch, Reader, group_by_pose
from jaxunshear.data.sources import Examples
from jaxunshear.data.stored_sets import SetReader, open_set

TAPS, ONE, ANOTHER = "tap_pins", "one_pins", "another_pins"
Batches = Callable[[int], Iterator[Batch]]


def select_few_pairs(examples: Examples, share: float, seed: int) -> Examples:
    """Select the training and validation slides of a `share` of the poses, at least one.

    `examples` are simulated. An epoch stays as long as it is with all pairs.
    """
    stored = _get_set_reader(examples)

    def load(split: str) -> Batch:
        rows = stored.rows(split)
        if split == "test":
            return dict(rows)
        selected = choose_poses(rows["stimulus"], rows["pose_id"], share, seed)
        return {name: value[selected] for name, value in rows.items()}

    return examples._replace(reader=Reader(load, examples.pins.size))


def choose_poses(stimulus: np.ndarray, pose_id: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Return whether the pose of each row is chosen, (N,).

    Smaller shares lie within larger ones of the same seed.
    """
    poses, row = np.unique(np.stack([stimulus, pose_id], axis=1), axis=0, return_inverse=True)
    hashes = [hash_text(f"pair {seed} {s} {p}") for s, p in poses.tolist()]
    order = sorted(range(len(poses)), key=hashes.__getitem__)
    is_chosen = np.zeros(len(poses), bool)
    is_chosen[order[: max(1, round(share * len(poses)))]] = True
    return is_chosen[row.reshape(-1)]


def add_single_contacts(
    batches: Batches, config: NetworkConfig, examples: Examples, data_dir: Path
) -> Batches:
    """Add the taps and slides without partners that the losses of a network take."""
    count = max(1, config.training.batch // 2)  # in a step, in addition to the pairs
    if config.taps:
        taps = open_set(config.taps, data_dir, config.sensor)
        batches = add_taps(batches, taps, count, config.seed)
    if "consistency" in config.training.losses:
        batches = add_same_pose_slides(batches, examples, count, config.seed)
    return batches


def add_taps(batches: Batches, taps: Reader, count: int, seed: int) -> Batches:
    """Add the pins of `count` taps to each batch, drawn by seed and step."""
    tap_batches = taps.train_batches(count, seed, 0.0, ("pins",))

    def start_batches(start: int = 0) -> Iterator[Batch]:
        for batch, tap_batch in zip(batches(start), tap_batches(start), strict=True):
            yield batch | {TAPS: tap_batch["pins"]}

    return start_batches


def add_same_pose_slides(batches: Batches, examples: Examples, count: int, seed: int) -> Batches:
    """Add `count` pairs of training slides to one pose to each batch, drawn by seed and step.

    A slide that is the only one to its pose is paired with itself.
    """

    def start_batches(start: int = 0) -> Iterator[Batch]:
        rows = _get_set_reader(examples).rows("train")
        pins, groups = rows["sheared_pins"], group_by_pose(rows["stimulus"], rows["pose_id"])
        for step, batch in enumerate(batches(start), start):
            generator = np.random.default_rng((seed, step))
            one = generator.integers(len(pins), size=count)
            another = groups.sample_other(one, generator)
            yield batch | {ONE: pins[one], ANOTHER: pins[another]}

    return start_batches


def _get_set_reader(examples: Examples) -> SetReader:
    assert isinstance(examples.reader, SetReader)  # simulated
    return examples.reader
