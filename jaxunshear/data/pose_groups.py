"""Group the rows of a split that have the same pose on the same stimulus.

Several slides may share a pose; each row holds one of the pose's taps.

>>> groups = group_by_pose(rows["stimulus"], rows["pose_id"])
>>> groups.sample_any(np.arange(64), generator)  # (64,) rows
"""

from typing import NamedTuple

import numpy as np


class PoseGroups(NamedTuple):
    """Rows by pose."""

    group: np.ndarray  # (N,) of each row
    rank: np.ndarray  # (N,) of each row in its group
    members: np.ndarray  # (N,) rows, group by group
    start: np.ndarray  # (groups,) where each begins in `members`
    size: np.ndarray  # (groups,)

    def get_group(self, row: int) -> np.ndarray:
        """Return all rows of a row's group, itself among them."""
        start = self.start[self.group[row]]
        return self.members[start : start + self.size[self.group[row]]]

    def sample_any(self, rows: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Sample one row (B,) of each row's group."""
        group = self.group[rows]
        return self.members[self.start[group] + generator.integers(self.size[group])]

    def sample_other(self, rows: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Sample another row (B,) of each row's group, or itself if there is no other."""
        group = self.group[rows]
        rank = sample_next(self.rank[rows], self.size[group], generator)
        return self.members[self.start[group] + rank]


def sample_next(index: np.ndarray, size: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Sample another index (B,) below `size` (B,), or the same if there is but one."""
    return (index + 1 + generator.integers(np.maximum(size - 1, 1))) % size


def group_by_pose(stimulus: np.ndarray, pose: np.ndarray) -> PoseGroups:
    """Group rows (N,) by their stimulus and the number of their pose on it."""
    _, group = np.unique(np.stack([stimulus, pose], axis=-1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    members, size = np.argsort(group, kind="stable"), np.bincount(group)
    start = np.cumsum(size) - size
    rank = np.empty_like(members)
    rank[members] = np.arange(len(members)) - start[group[members]]
    return PoseGroups(group, rank, members, start, size)
