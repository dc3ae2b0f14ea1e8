"""Rows of a split that are of the same pose of the same stimulus, several slides say: each holds one of the pose's taps.

>>> siblings = group_by_pose(rows["stimulus"], rows["pose_id"])
>>> siblings.drawn(np.arange(64), generator)  # (64,) rows
"""

from typing import NamedTuple

import numpy as np


class PoseGroups(NamedTuple):
    group: np.ndarray  # (N,) of each row
    rank: np.ndarray  # (N,) of each row in its group
    members: np.ndarray  # (N,) rows, group by group
    start: np.ndarray  # (groups,) where each begins
    size: np.ndarray  # (groups,)

    def get_group(self, row: int) -> np.ndarray:
        """All of a row's group, itself among them."""
        start = self.start[self.group[row]]
        return self.members[start : start + self.size[self.group[row]]]

    def sample_any(self, rows: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """One of each row's group (B,): any."""
        group = self.group[rows]
        return self.members[self.start[group] + generator.integers(self.size[group])]

    def sample_other(self, rows: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """One of each row's group (B,), another one where there is one."""
        group = self.group[rows]
        return self.members[
            self.start[group] + sample_next(self.rank[rows], self.size[group], generator)
        ]


def sample_next(place: np.ndarray, size: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Another place (B,) below `size` (B,), any; the same where there is but one."""
    return (place + 1 + generator.integers(np.maximum(size - 1, 1))) % size


def group_by_pose(stimulus: np.ndarray, pose: np.ndarray) -> PoseGroups:
    """Of rows (N,) by what they touch and the number of their pose there."""
    _, group = np.unique(np.stack([stimulus, pose], axis=-1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    members, size = np.argsort(group, kind="stable"), np.bincount(group)
    start = np.cumsum(size) - size
    rank = np.empty_like(members)
    rank[members] = np.arange(len(members)) - start[group[members]]
    return PoseGroups(group, rank, members, start, size)
