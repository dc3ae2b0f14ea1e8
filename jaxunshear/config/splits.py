"""Which split a simulated pose is in: a matter of its seed, its stimulus and its number alone.

So all sets of one seed agree, whatever their sizes, slides and other stimuli: what one trains on no other tests.
"""

import hashlib
from functools import lru_cache

import numpy as np

SPLITS = ("train", "validation", "test")
BLOCK = 5  # consecutive poses of a stimulus: one is for validation, one for test, three are for training


def assign_split(seed: int, stimulus: str, pose: int) -> int:
    """Index into SPLITS."""
    held = _draw_held_out(seed, stimulus, pose // BLOCK)
    return {held[0]: 1, held[1]: 2}.get(pose % BLOCK, 0)


def assign_splits(seed: int, stimulus: str, poses: int) -> np.ndarray:
    """(poses,) index into SPLITS. 60:20:20 for full blocks; a last, broken one gives what its poses are."""
    return np.array([assign_split(seed, stimulus, pose) for pose in range(poses)], int)


def count_train_poses(seed: int, stimulus: str, poses: int) -> int:
    """How many of them are for training; takes no time for any number."""
    full, rest = divmod(poses, BLOCK)
    last = (assign_split(seed, stimulus, full * BLOCK + place) for place in range(rest))
    return full * (BLOCK - 2) + sum(split == 0 for split in last)


def hash_text(key: str) -> int:
    """64 bits that depend on the text alone."""
    return int.from_bytes(hashlib.blake2b(key.encode(), digest_size=8).digest(), "big")


@lru_cache
def _draw_held_out(seed: int, stimulus: str, block: int) -> tuple[int, int]:
    """Places in a block of its poses for validation and for test, drawn by a hash."""
    test, step = divmod(hash_text(f"{seed} {stimulus} {block}") % (BLOCK * (BLOCK - 1)), BLOCK - 1)
    return (test + 1 + step) % BLOCK, test
