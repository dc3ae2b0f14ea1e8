"""Contacts that no calibration has seen: which images of a recording a comparison may use, and which only align it."""

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.sampling import Recorded, load, open_recordings, rows_by_folder
from jaxunshear.errors import UserError

ALIGNED_BY = 100  # images of a folder, at most
SHARE = 3  # of a folder's images at most one in so many aligns it


class Parts(NamedTuple):
    """One folder's images: those that show how labels and images go together, and others that are compared."""

    align: Recorded
    scored: Recorded


def held_out(path: Path, each: int | None, seed: int, used: Collection[str]) -> tuple[list[Parts], list[str]]:
    """Every folder of recordings at `path` in two parts, and notes. `each`: images a folder that are compared, at most; None: all.

    What `used` names (images as `Recorded.names` has them, or the end of such a name) is not compared; it aligns, before others do.
    Raises `UserError` where nothing is left to compare.
    """
    recordings, notes = open_recordings(path)
    generator, spent = np.random.default_rng(seed), among(recordings.names, used)
    align, scored = [], []
    for rows in rows_by_folder(recordings):
        rows = generator.permutation(rows)
        seen = spent[rows]
        fresh, count = rows[~seen], min(ALIGNED_BY, -(-len(rows) // SHARE))
        if seen.any():
            folder = recordings.names[rows[0]].rpartition("/")[0] or path.name
            notes.append(
                f"{folder}: {int(seen.sum())} of {len(rows)} images, which the calibration was fitted to, are not compared"
            )
        missing = max(0, count - int(seen.sum()))
        align.append(np.sort(np.concatenate([rows[seen][:count], fresh[:missing]])))
        scored.append(np.sort(fresh[missing:][:each]))
    if not any(len(rows) for rows in scored):
        raise UserError(f"{path}: the calibration was fitted to all its images: compare with others")
    kept = [(a, s) for a, s in zip(align, scored, strict=True) if len(s)]
    first, more = load(recordings, [pair[0] for pair in kept])
    second, still = load(recordings, [pair[1] for pair in kept])
    by_name = {part.name: part for part in first}
    return [Parts(by_name[part.name], part) for part in second if part.name in by_name], notes + more + still


def among(names: Collection[str], used: Collection[str]) -> np.ndarray:
    """(N,) bool: names that are `used`, also where folders were given from higher up or lower down: one path ends with the other."""
    wanted, ends = set(used), {end for name in used for end in _ends(name)}
    return np.array([name in ends or any(end in wanted for end in _ends(name)) for name in names], bool)


def _ends(name: str) -> list[str]:
    parts = name.split("/")
    return ["/".join(parts[i:]) for i in range(len(parts))]
