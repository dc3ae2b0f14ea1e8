"""Assign simulated poses to splits, by nothing but their seed, stimulus and number.

So all sets of one seed agree, whatever their sizes, slides and other stimuli: no pose that one set
trains on is a test pose of another.
"""

import hashlib
from functools import lru_cache

import numpy as np

SPLITS = ("train", "validation", "test")
# consecutive poses of a stimulus: one for validation, one for test, three for training
BLOCK = 5


def assign_split(seed: int, stimulus: str, pose: int) -> int:
    """Return the split of a pose as an index into SPLITS."""
    validation, test = _draw_held_out(seed, stimulus, pose // BLOCK)
    return {validation: 1, test: 2}.get(pose % BLOCK, 0)


def assign_splits(seed: int, stimulus: str, poses: int) -> np.ndarray:
    """Return the splits of poses, (poses,) indices into SPLITS; 60:20:20 in full blocks."""
    return np.array([assign_split(seed, stimulus, pose) for pose in range(poses)], int)


def count_train_poses(seed: int, stimulus: str, poses: int) -> int:
    """Count the poses for training, in the same short time for any number."""
    full, rest = divmod(poses, BLOCK)
    last = (assign_split(seed, stimulus, full * BLOCK + place) for place in range(rest))
    return full * (BLOCK - 2) + sum(split == 0 for split in last)


def hash_text(key: str) -> int:
    """Hash a text to 64 bits, on every machine the same."""
    return int.from_bytes(hashlib.blake2b(key.encode(), digest_size=8).digest(), "big")


@lru_cache
def _draw_held_out(seed: int, stimulus: str, block: int) -> tuple[int, int]:
    """Draw by a hash which places in a block are for validation and for test."""
    test, step = divmod(hash_text(f"{seed} {stimulus} {block}") % (BLOCK * (BLOCK - 1)), BLOCK - 1)
    return (test + 1 + step) % BLOCK, test
