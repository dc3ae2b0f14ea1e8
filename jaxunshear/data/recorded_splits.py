"""Split recorded contacts: by the names of their folders, by chance, or by a block of poses.

split, note = cut_block(pose, test=0.1, validation=0.1, seed=0)

The poses of a random tenth lie between training poses that differ by little. A block is cut
along one label, well inside its range: networks must interpolate over the gap, but need not
extrapolate. The poses on either side of the block are for validation. So the gap costs no
contact, and what validation chooses is chosen on poses that are kept out, too.
"""

import re
from pathlib import Path

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.splits import SPLITS, hash_text
from jaxunshear.config.targets import make_label_targets
from jaxunshear.errors import UserError

DIGITS = 4  # mm or deg: labels that agree so far count as one value
TRAIN, VALIDATION, TEST = range(len(SPLITS))
RANDOM_REMEDY = "use --paired.split random"
SPLIT_NAMES = {
    "train": "train",
    "val": "validation",
    "valid": "validation",
    "validation": "validation",
    "test": "test",
}


def read_folder_split(file: Path, name: str) -> str:
    """Read the split that a contact's folders name (`csv_train`, `val`, `test_2`), or "".

    These are the folders below the one that the settings name, and that one.
    """
    folders = file.parent.resolve().parts[-1 - name.count("/") :]
    for folder in reversed(folders):
        for word in re.split(r"[^a-z]+", folder.lower()):
            if word in SPLIT_NAMES:
                return SPLIT_NAMES[word]
    return ""


def split_by_folders(
    kind: str, folder_split: np.ndarray, keys: np.ndarray, settings: Recorded
) -> np.ndarray:
    """Split the taps, or the slides: (n,) indices into SPLITS.

    Names of folders count only if some contacts are left to learn from: a folder that happens to be
    called `test` is no split. `keys` (n,) decide where names leave the split open.
    """
    is_open = (folder_split == "") | (folder_split == "train")
    if not is_open.any():
        folder_split, is_open = np.full_like(folder_split, ""), np.full(len(keys), True)
    split = np.zeros(len(keys), int)
    for index, name in enumerate(SPLITS):
        split[folder_split == name] = index
    start = 0.0
    for name, share in (("test", settings.test), ("validation", settings.validation)):
        if name in folder_split:
            continue
        if settings.split == "folder":
            raise UserError(
                f"paired.split folder: no folder of {kind}s has the name of the split '{name}', "
                f"such as csv_{name}: move contacts into one, or use --paired.split random"
            )
        chosen = is_open & (keys >= start) & (keys < start + share)
        rest = is_open & (split == 0)
        if not chosen.any() and rest.sum() > len(SPLITS):  # of few contacts chance may take none
            chosen = rest & (keys == keys[rest].min())
        split[chosen] = SPLITS.index(name)
        start += share
    return split


def cut_block(
    pose: np.ndarray, test: float, validation: float, seed: int
) -> tuple[np.ndarray, str]:
    """Split poses (N, 6), mm and deg without NaN, into test, validation and training poses.

    Returns (N,) indices into SPLITS, and a sentence that says where the block lies. `test` and
    `validation` are shares of the poses; `seed` draws the block's place along the label.
    Raises UserError if no label takes enough values to leave a gap.
    """
    varying = make_label_targets((), pose)
    if not varying:
        raise UserError(f"paired.split block: no label of the poses varies: {RANDOM_REMEDY}")
    # the label of the most values; a full circle only if nothing else varies
    ranges = [target for target in varying if not target.is_circular]
    target = max(ranges or varying, key=lambda target: _count_values(pose[:, target.column]))
    value = pose[:, target.column]
    outer, inner = (test + validation) / 2, test / 2
    margin = min(2 * outer, 0.5)  # so training poses remain on both sides
    middle = margin + (1 - 2 * margin) * hash_text(f"block {seed}") / 2**64
    ends = middle + np.array([-outer, -inner, inner, outer])
    start, first, last, end = np.quantile(value, ends)
    if start == first or last == end:
        raise UserError(
            f"paired.split block: {target.name} takes only {_count_values(value)} values, "
            "too few to leave a gap between test and training: "
            f"raise --paired.validation, or {RANDOM_REMEDY}"
        )
    split = np.full(len(value), TRAIN)
    split[(value >= start) & (value <= end)] = VALIDATION
    split[(value >= first) & (value <= last)] = TEST
    name, unit = target.name.rsplit("_", 1)
    gap = min(first - start, end - last)
    return split, (
        f"split block: test poses have {name} from {first:.4g} to {last:.4g} {unit}; "
        f"no training pose lies within {gap:.3g} {unit} of them"
    )


def _count_values(value: np.ndarray) -> int:
    return len(np.unique(np.round(value, DIGITS)))
