"""Keep a block of poses out of training, so that no test pose has a training pose close by.

split, note = cut_block(pose, test=0.1, validation=0.1, seed=0)

The poses of a random tenth lie between training poses that differ by little. The block is cut
along one label, well inside its range: networks must interpolate over the gap, but need not
extrapolate. The poses on either side of the block are for validation. So the gap costs no
contact, and what validation chooses is chosen on poses that are kept out, too.
"""

import numpy as np

from jaxunshear.config.splits import SPLITS, hash_text
from jaxunshear.config.targets import Target, make_label_targets
from jaxunshear.errors import UserError

DIGITS = 4  # mm or deg: labels that agree so far count as one value
TRAIN, VALIDATION, TEST = range(len(SPLITS))
RANDOM_REMEDY = "use --paired.split random"


def cut_block(
    pose: np.ndarray, test: float, validation: float, seed: int
) -> tuple[np.ndarray, str]:
    """Split poses (N, 6), mm and deg without NaN, into test, validation and training poses.

    Returns (N,) indices into SPLITS, and a sentence that says where the block lies. `test` and
    `validation` are shares of the poses; `seed` draws the block's place along the label.
    Raises UserError if no label takes enough values to leave a gap.
    """
    target = _choose_label(pose)
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


def _choose_label(pose: np.ndarray) -> Target:
    """Choose the label of the most values; a full circle only if nothing else varies."""
    varying = make_label_targets((), pose)
    if not varying:
        raise UserError(f"paired.split block: no label of the poses varies: {RANDOM_REMEDY}")
    ranges = [target for target in varying if not target.is_circular]
    return max(ranges or varying, key=lambda target: _count_values(pose[:, target.column]))


def _count_values(value: np.ndarray) -> int:
    return len(np.unique(np.round(value, DIGITS)))
