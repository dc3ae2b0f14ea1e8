"""Conformal intervals: half-widths that contain 95 % of the errors on validation contacts.

No distribution is assumed (split conformal). The coverage is guaranteed for contacts drawn like
those of the validation, so of the same session. On other recordings errors can be larger, and the
widths contain fewer of them; `compute_coverage` computes how many.
"""

import math
from collections.abc import Mapping

import numpy as np

from jaxunshear.evaluation.bootstrap import LEVEL

MIN_CONTACTS = 20  # no half-width contains 95 % of fewer
# coverage of unsheared slides in docs/results/locked/recorded_pins_seed0.json
COVERAGE_ELSEWHERE = {"y_mm": 0.9405, "z_mm": 0.8195, "Rz_deg": 0.9455}
_SHARES = (
    f"{100 * share:.0f} % of {name.partition('_')[0]}" for name, share in COVERAGE_ELSEWHERE.items()
)
ELSEWHERE_NOTE = (
    f"On other recordings of a public edge, unsheared over pins, they held {', '.join(_SHARES)}"
)
ByKind = dict[str, dict[str, float]]  # by kind of contact and target


def compute_half_widths(errors: Mapping[str, np.ndarray]) -> ByKind:
    """Compute half-widths from absolute errors (N,), mm or deg, by `pose/<kind>/<target>`."""
    widths: ByKind = {}
    for name, values in errors.items():
        table, kind, *target = name.split("/")
        count = len(values)
        if table == "pose" and count >= MIN_CONTACTS:
            rank = min(count, math.ceil(round(LEVEL * (count + 1), 9)))
            widths.setdefault(kind, {})[target[0]] = float(np.sort(values)[rank - 1])
    return widths


def compute_coverage(
    widths: Mapping[str, Mapping[str, float]], errors: Mapping[str, np.ndarray]
) -> ByKind:
    """Compute the share of other contacts' errors that the half-widths contain."""
    coverage: ByKind = {}
    for kind, targets in widths.items():
        for target, width in targets.items():
            values = errors.get(f"pose/{kind}/{target}")
            if values is not None:
                coverage.setdefault(kind, {})[target] = float(np.mean(values <= width))
    return coverage
