"""What is predicted of a contact: one definition for PoseNet, tables, CSV and recoveries.

>>> targets = make_range_targets((), Ranges())                      # a simulated set's: x, yaw, edge distance, edge angle
>>> targets = make_label_targets(("y_mm", "Rz_deg:circle"), poses, moves)  # of recorded training contacts, (N, 6) each
>>> read_true_values(targets, batch)["y_mm"]                    # (B,)

A target is written `name`, `name:range`, `name:circle` or with a loss weight behind, `name:range:4`. A range is scaled to [0, 1]
about its middle; an angle over the full circle is two outputs, its cosine and sine, and its errors go the short way round.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from jaxunshear.config.data import Ranges
from jaxunshear.errors import UserError
from jaxunshear.files import Json

RANGE, CIRCLE = "range", "circle"
SIMULATED_FIELDS = {  # name: the field of a simulated set and its column
    "x_mm": ("pose", 0),
    "y_mm": ("pose", 1),
    "yaw_deg": ("pose", 2),
    "depth_mm": ("pose", 3),
    "edge_mm": ("edge", 0),
    "edge_deg": ("edge", 1),
    "tilt_x_deg": ("pose", 4),
    "tilt_y_deg": ("pose", 5),
}
RECORDED_FIELDS = {
    name: ("pose", i)
    for i, name in enumerate(("x_mm", "y_mm", "z_mm", "Rx_deg", "Ry_deg", "Rz_deg"))
}
# of recorded slides, in the labels' own frame; of simulated ones, in the sensor's
LABELLED_SLIDES = {f"slide_{name}": ("move", i) for name, (_, i) in RECORDED_FIELDS.items()}
SENSOR_SLIDES = {
    name: ("felt", i) for i, name in enumerate(("slide_x_mm", "slide_y_mm", "slide_twist_deg"))
}
# The paper's x and yaw, and two that an edge does not leave open; edge distance has the widest scale and would drown in the
# ambiguous yaw.
PAPER_TARGETS = ("x_mm", "yaw_deg", "edge_mm:range:4", "edge_deg:circle")
MIN_VARIATION = 1e-6  # mm or deg: labels that vary by less do not vary
FULL_CIRCLE_DEG = 300.0  # labels that spread over more are taken for a full circle


@dataclass(frozen=True)
class Target:
    """One quantity: where its label stands in a batch, and how it is scaled for the network."""

    name: str  # ends in its unit, _mm or _deg
    field: str
    column: int
    centre: float = 0.0  # of the range, mm or deg
    half_range: float = 1.0  # half of the range
    is_circular: bool = False
    weight: float = 1.0  # in the loss

    @property
    def outputs(self) -> int:
        return 2 if self.is_circular else 1


Targets = tuple[Target, ...]


def parse_target(text: str, known: Iterable[str]) -> tuple[str, str | None, float]:
    """Name, kind (None: to be chosen) and weight of `name[:kind[:weight]]`. Raises UserError."""
    name, *more = text.split(":")
    if name not in known:
        raise UserError(f"target '{name}' is unknown: use {', '.join(known)}")
    kind = more[0] if more else None
    if kind not in (None, RANGE, CIRCLE) or len(more) > 2:
        raise UserError(
            f"target '{text}' is not understood: write {name}, {name}:{RANGE} or {name}:{CIRCLE}:2"
        )
    if kind == CIRCLE and not name.endswith("_deg"):
        raise UserError(f"target '{text}': only an angle goes round a circle; write {name}:{RANGE}")
    try:
        weight = float(more[1]) if len(more) > 1 else 1.0
    except ValueError:
        weight = 0.0
    if not 0 < weight < 1e6:
        raise UserError(f"target '{text}': the weight in the loss is a number above 0")
    return name, kind, weight


def make_range_targets(names: Sequence[str], ranges: Ranges) -> Targets:
    """Of a simulated set; without names those of PAPER that its ranges vary. Raises UserError for what does not vary."""
    lateral, depth = ranges.lateral_mm, (ranges.depth_min_mm, ranges.depth_max_mm)
    spans = {
        "x_mm": (-lateral, lateral),
        "y_mm": (-lateral, lateral),
        "yaw_deg": (-ranges.yaw_deg, ranges.yaw_deg),
        "depth_mm": depth,
        "edge_mm": (
            -(2**0.5) * lateral,
            2**0.5 * lateral,
        ),  # the target point lies on the edge: a bound
        "edge_deg": (-180.0, 180.0) if lateral or ranges.yaw_deg else (0.0, 0.0),
        "tilt_x_deg": (-ranges.tilt_deg, ranges.tilt_deg),
        "tilt_y_deg": (-ranges.tilt_deg, ranges.tilt_deg),
    }
    return _targets(names, PAPER_TARGETS, SIMULATED_FIELDS, spans)


def make_label_targets(
    names: Sequence[str], poses: np.ndarray, moves: np.ndarray | None = None
) -> Targets:
    """Of poses and moves (N, 6) mm and deg of recorded training contacts, NaN where unknown; without names all columns of the pose that
    vary. Raises UserError."""
    known = np.isfinite(poses).all(axis=1)
    if not known.any():
        return ()
    labels = np.concatenate([poses, np.zeros_like(poses) if moves is None else moves], axis=1)[
        known
    ]
    low, high = labels.min(axis=0), labels.max(axis=0)
    spans = {
        name: (float(low[i]), float(high[i]))
        for i, name in enumerate(RECORDED_FIELDS | LABELLED_SLIDES)
    }
    return _targets(names, tuple(RECORDED_FIELDS), RECORDED_FIELDS | LABELLED_SLIDES, spans)


def make_slide_targets(ranges: Ranges) -> Targets:
    """What a simulated set varies of its slides."""
    move, twist = (-ranges.move_mm, ranges.move_mm), (-ranges.twist_deg, ranges.twist_deg)
    return _targets(
        (),
        tuple(SENSOR_SLIDES),
        SENSOR_SLIDES,
        dict(zip(SENSOR_SLIDES, (move, move, twist), strict=True)),
    )


def make_move_targets(moves: np.ndarray) -> Targets:
    """What the labels (N, 6) mm and deg of recorded training slides vary, NaN where unknown."""
    known = moves[np.isfinite(moves).all(axis=1)]
    if not len(known):
        return ()
    ends = zip(known.min(axis=0).tolist(), known.max(axis=0).tolist(), strict=True)
    return _targets(
        (), tuple(LABELLED_SLIDES), LABELLED_SLIDES, dict(zip(LABELLED_SLIDES, ends, strict=True))
    )


def list_slide_names(names: Sequence[str]) -> list[str]:
    """The names among `names` that are of a slide."""
    return [name for name in (text.partition(":")[0] for text in names) if name in LABELLED_SLIDES]


def _targets(
    wanted: Sequence[str],
    usual: Sequence[str],
    known: Mapping[str, tuple[str, int]],
    spans: Mapping[str, tuple[float, float]],
) -> Targets:
    targets = []
    for text in wanted or usual:
        name, kind, weight = parse_target(text, known)
        low, high = spans[name]
        if high - low <= MIN_VARIATION:
            if wanted:
                raise UserError(f"target '{name}' does not vary in this data set: leave it out")
            continue
        circle = kind == CIRCLE or (
            kind is None and name.endswith("_deg") and high - low > FULL_CIRCLE_DEG
        )
        field, column = known[name]
        middle, reach = (0.0, 1.0) if circle else ((low + high) / 2, (high - low) / 2)
        targets.append(Target(name, field, column, middle, reach, circle, weight))
    return tuple(targets)


def list_label_fields(targets: Targets) -> tuple[str, ...]:
    """The fields of a batch that hold the labels."""
    return tuple(dict.fromkeys(target.field for target in targets))


def list_target_names(targets: Targets) -> tuple[str, ...]:
    return tuple(target.name for target in targets)


def read_true_values(targets: Targets, batch: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The labels (B,) by name, of a batch with the fields of `list_label_fields`."""
    return {target.name: batch[target.field][:, target.column] for target in targets}


def to_json(targets: Targets) -> list[Json]:
    return [asdict(target) for target in targets]


def from_json(stored: Any, source: str) -> Targets:
    """The inverse of `to_json`. Raises UserError."""
    try:
        return tuple(Target(**each) for each in stored)
    except TypeError as error:
        raise UserError(
            f"{source} states no pose targets that this version knows: train again"
        ) from error
