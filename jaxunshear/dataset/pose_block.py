"""A block of poses kept out of training, so that no test pose has a near neighbour among the training poses.

split, note = cut_block(pose, test=0.1, validation=0.1, seed=0)

A random tenth flatters: each of its poses lies between training poses that differ by little. The block is cut along one
label, well inside that label's range: networks must interpolate over the gap, but need not extrapolate. The poses on either
side of the block are for validation. So the gap costs no contact, and what validation chooses is chosen on poses kept out.
"""

import numpy as np

from jaxunshear.errors import UserError
from jaxunshear.settings.splits import SPLITS, hashed
from jaxunshear.settings.targets import Target, of_labels

DIGITS = 4  # mm or deg: labels that agree so far count as one value


def cut_block(pose: np.ndarray, test: float, validation: float, seed: int) -> tuple[np.ndarray, str]:
    """Split poses (N, 6), mm and deg without NaN: (N,) indices into SPLITS, and a sentence that says where the block lies.

    `test` and `validation` are shares of the poses; `seed` draws where along the label the block lies.
    Raises UserError where no label takes enough values to leave a gap.
    """
    target = _choose_label(pose)
    value = pose[:, target.column]
    outer, inner = (test + validation) / 2, test / 2
    margin = min(2 * outer, 0.5)  # of training poses remain on both sides
    middle = margin + (1 - 2 * margin) * hashed(f"block {seed}") / 2**64
    start, first, last, end = np.quantile(value, middle + np.array([-outer, -inner, inner, outer]))
    if start == first or last == end:
        raise UserError(
            f"paired.split block: {target.name} takes only {_count_values(value)} values, too few to leave a gap between "
            "test and training: raise --paired.validation, or use --paired.split random"
        )
    split = np.full(len(value), SPLITS.index("train"))
    split[(value >= start) & (value <= end)] = SPLITS.index("validation")
    split[(value >= first) & (value <= last)] = SPLITS.index("test")
    name, unit = target.name.rsplit("_", 1)
    return split, (
        f"split block: test poses have {name} from {first:.4g} to {last:.4g} {unit}; no training pose lies within "
        f"{min(first - start, end - last):.3g} {unit} of them"
    )


def _choose_label(pose: np.ndarray) -> Target:
    """The label of the most values; an angle over the full circle only where nothing else varies."""
    varying = of_labels((), pose)
    if not varying:
        raise UserError("paired.split block: no label of the poses varies: use --paired.split random")
    ranges = [target for target in varying if not target.circle]
    return max(ranges or varying, key=lambda target: _count_values(pose[:, target.column]))


def _count_values(value: np.ndarray) -> int:
    return len(np.unique(np.round(value, DIGITS)))
