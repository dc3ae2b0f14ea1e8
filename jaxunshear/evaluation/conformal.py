"""How far an answer may be off: half-widths that hold 95 % of the errors on validation contacts, tried on others.

Split conformal: no distribution is assumed. The promise is for contacts drawn as those of the
validation, so of the same session. On other recordings errors can be larger, and the widths hold
fewer of them; `compute_coverage` says how many.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from jaxunshear.evaluation.bootstrap import LEVEL

MIN_CONTACTS = 20  # contacts: of fewer no width holds 95 %
# coverage of unsheared slides in docs/results/locked/recorded_pins_seed0.json
COVERAGE_ELSEWHERE = {"y_mm": 0.9405, "z_mm": 0.8195, "Rz_deg": 0.9455}
_SHARES = (
    f"{100 * share:.0f} % of {name.partition('_')[0]}" for name, share in COVERAGE_ELSEWHERE.items()
)
ELSEWHERE_NOTE = (
    f"On other recordings of a public edge, unsheared over pins, they held {', '.join(_SHARES)}"
)
ByMethod = dict[str, dict[str, float]]  # way of perceiving: target: mm or deg, or a share


def compute_half_widths(errors: Mapping[str, np.ndarray]) -> ByMethod:
    """Of absolute errors (N,) mm or deg by `pose/<way>/<target>`."""
    found: ByMethod = {}
    for way, name, values in _by_way(errors):
        if (count := len(values)) >= MIN_CONTACTS:
            held = min(count, math.ceil(round(LEVEL * (count + 1), 9)))
            found.setdefault(way, {})[name] = float(np.sort(values)[held - 1])
    return found


def compute_coverage(
    widths: Mapping[str, Mapping[str, float]], errors: Mapping[str, np.ndarray]
) -> ByMethod:
    """The share of `errors`, as above but of other contacts, that the half-widths hold; of what both know."""
    found: ByMethod = {}
    for way, name, values in _by_way(errors):
        if (width := widths.get(way, {}).get(name)) is not None:
            found.setdefault(way, {})[name] = float(np.mean(values <= width))
    return found


def _by_way(errors: Mapping[str, np.ndarray]) -> Iterator[tuple[str, str, np.ndarray]]:
    for name, values in errors.items():
        table, way, *target = name.split("/")
        if table == "pose":
            yield way, target[0], values
