"""What walks around an object are worth: how much of the outline, how close to it, how they ended."""

import numpy as np

from jaxunshear.applications.contour import Contour, off
from jaxunshear.applications.servo import CLOSED, ENDS, LATE, Walks
from jaxunshear.storage import Json


def walk_rows(walks: Walks, line: Contour, stimulus: str) -> list[Json]:
    """A row for each way of perceiving: means over its walks, distances over all of their steps.

    `mean_mm`, `p95_mm` and `largest_mm`: of the trajectory, which the controller holds to the edge, from the outline; `walk_mm` its
    mean walk by walk; `seen_*`: of where the edge was perceived to be, from the outline. A walk that was lost counts until there.
    `unfollowed`: steps whose pins were not identified for sure, where networks over pins perceive; the sensor then goes straight on.
    """
    rows = []
    for way in dict.fromkeys(walks.way.tolist()):
        mine = np.flatnonzero(walks.way == way)
        tracks = [off(line, walks.point[w, ~np.isnan(walks.point[w, :, 0]), :2]) for w in mine]
        edge = np.concatenate([seen_edge(walks, int(w)) for w in mine])
        apart, seen = np.concatenate(tracks), off(line, edge)
        ends = {ENDS[end]: int(np.sum(walks.end[mine] == end)) for end in range(CLOSED, LATE + 1)}
        taken = np.sum(~np.isnan(walks.point[mine, :, 0]))
        rows.append(
            {
                "name": f"{stimulus}/{way}",
                "stimulus": stimulus,
                "way": way,
                "starts": len(mine),
                "completed": float(np.mean(np.clip(walks.way_mm[mine] / line.length, 0, 1))),
                "closed": ends[ENDS[CLOSED]],
                "mean_mm": float(apart.mean()),
                "walk_mm": [float(track.mean()) for track in tracks],
                "p95_mm": float(np.percentile(apart, 95)),
                "largest_mm": float(apart.max()),
                "seen_mean_mm": float(seen.mean()) if len(seen) else None,
                "ends": {name: count for name, count in ends.items() if count},
                "unsolved": int(walks.unsolved[mine].sum()),
                "steps": int(taken),
                "unfollowed": int(taken - np.sum(~np.isnan(walks.seen[mine, :, 0]))),
                "perceive_ms": float(1e3 * walks.perceive_s[mine].sum() / max(taken, 1)),
            }
        )
    return rows


def seen_edge(walks: Walks, walk: int) -> np.ndarray:
    """(T, 2) mm, target frame: where walk `walk` perceived the edge, step by step."""
    point, seen = walks.point[walk], walks.seen[walk]
    there = ~np.isnan(point[:, 0]) & ~np.isnan(seen[:, 0])
    x, y, yaw = point[there].T
    distance, direction = seen[there].T
    angle = np.radians(yaw + direction)
    return np.stack([x - distance * np.cos(angle), y - distance * np.sin(angle)], -1)
