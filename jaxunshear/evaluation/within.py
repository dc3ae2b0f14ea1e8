"""How far an answer may be off: half-widths that hold 95 % of the errors on validation contacts, tried on others.

Split conformal: no distribution is assumed. One width for all contacts of a kind; how many it holds of contacts unlike those of the
validation, `coverage` says.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from jaxunshear.evaluation.spread import LEVEL

FEWEST = 20  # contacts: of fewer no width holds 95 %
ByWay = dict[str, dict[str, float]]  # way of perceiving: target: mm or deg, or a share


def half_widths(errors: Mapping[str, np.ndarray]) -> ByWay:
    """Of absolute errors (N,) mm or deg by `pose/<way>/<target>`."""
    found: ByWay = {}
    for way, name, values in _by_way(errors):
        if (count := len(values)) >= FEWEST:
            held = min(count, math.ceil(round(LEVEL * (count + 1), 9)))
            found.setdefault(way, {})[name] = float(np.sort(values)[held - 1])
    return found


def coverage(widths: Mapping[str, Mapping[str, float]], errors: Mapping[str, np.ndarray]) -> ByWay:
    """The share of `errors`, as above but of other contacts, that the half-widths hold; of what both know."""
    found: ByWay = {}
    for way, name, values in _by_way(errors):
        if (width := widths.get(way, {}).get(name)) is not None:
            found.setdefault(way, {})[name] = float(np.mean(values <= width))
    return found


def _by_way(errors: Mapping[str, np.ndarray]) -> Iterator[tuple[str, str, np.ndarray]]:
    for name, values in errors.items():
        table, way, *target = name.split("/")
        if table == "pose":
            yield way, target[0], values
