"""What is predicted of a contact: one definition for PoseNet, tables, CSV and recoveries.

>>> targets = make_range_targets((), Ranges())  # of a simulated set
>>> targets = make_label_targets(("y_mm", "Rz_deg:circle"), poses)  # of recorded taps, (N, 6)
>>> read_true_values(targets, batch)["y_mm"]  # (B,)

A target is written `name`, `name:range` or `name:circle`, or with a weight in the loss,
`name:range:4`. A range is scaled to [0, 1] about its middle. An angle over the full circle is two
outputs, its cosine and sine, and its errors go the short way round. A column whose name ends in
`_class`, as `object_class`, has integers from 0: an output for each, and an error of 0 or 1.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from jaxunshear.config.data import Ranges
from jaxunshear.errors import UserError
from jaxunshear.files import Json

RANGE, CIRCLE = "range", "circle"
CLASS = "_class"  # ends the names of classes
MAX_CLASSES = 100
TASK_POSE = "pose_"  # begins the fields of `name_pose_field`
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
# of recorded slides, in the frame of the labels
LABELLED_SLIDES = {f"slide_{name}": ("move", i) for name, (_, i) in RECORDED_FIELDS.items()}
OTHERS = "others"  # field of further columns of a recording's tables, as forces, by their names
# of simulated slides, in the frame of the sensor
SENSOR_SLIDES = {
    name: ("felt", i) for i, name in enumerate(("slide_x_mm", "slide_y_mm", "slide_twist_deg"))
}
# The paper's x and yaw, and two that a contact with an edge determines. Edge distance weighs most:
# its scale is the widest, so its errors would be small beside those of the ambiguous yaw.
PAPER_TARGETS = ("x_mm", "yaw_deg", "edge_mm:range:4", "edge_deg:circle")
MIN_VARIATION = 1e-6  # mm or deg: labels that vary by less do not vary
FULL_CIRCLE_DEG = 300.0  # angles that span more are taken for a full circle


@dataclass(frozen=True)
class Target:
    """One quantity: where its label is in a batch, and how it is scaled for the network."""

    name: str  # ends in its unit, _mm or _deg, or in _class, unless it is of a further column
    field: str
    column: int
    centre: float = 0.0  # of the range, mm or deg
    half_range: float = 1.0  # half of the range
    is_circular: bool = False
    weight: float = 1.0  # in the loss
    classes: int = 0  # of a class; 0 for a number

    @property
    def outputs(self) -> int:
        return self.classes or (2 if self.is_circular else 1)

    def scale(self, labels: np.ndarray) -> np.ndarray:
        """Scale labels (N,) to [-1, 1] over the range (N, 1), or to cosine and sine (N, 2)."""
        values = np.asarray(labels, np.float64)
        if self.is_circular:
            angle = np.radians(values)
            return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return (values[:, None] - self.centre) / self.half_range


Targets = tuple[Target, ...]


def count_outputs(targets: Targets) -> int:
    """Count the outputs K of all targets."""
    return sum(target.outputs for target in targets)


class TargetText(NamedTuple):
    """What `name[:kind[:weight]]` says."""

    name: str
    kind: str | None  # RANGE, CIRCLE, or None: as the data suggest
    weight: float


def parse_target(text: str, names: Iterable[str]) -> TargetText:
    """Parse a target whose name must be among `names`. Raises UserError."""
    name, *more = text.split(":")
    if name not in names:
        raise UserError(f"target '{name}' is unknown: use {', '.join(names)}")
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
    return TargetText(name, kind, weight)


def list_text_problems(texts: Sequence[str], names: Iterable[str]) -> list[str]:
    """List what is wrong with the texts of targets, whose names must be among `names`."""
    problems, parsed = [], []
    for text in texts:
        try:
            parsed.append(parse_target(text, names).name)
        except UserError as error:
            problems.append(str(error))
    return problems + (["name each once"] if len(set(parsed)) < len(parsed) else [])


def make_range_targets(
    texts: Sequence[str], ranges: Ranges, defaults: Sequence[str] = PAPER_TARGETS
) -> Targets:
    """Make the targets of a simulated set; without texts, those of `defaults` that vary.

    Raises UserError for a text that is no target, or whose target does not vary.
    """
    lateral = ranges.lateral_mm
    edge = 2**0.5 * lateral  # a bound: the point that poses are relative to lies on the edge
    edge_deg = 180.0 if lateral or ranges.yaw_deg else 0.0
    spans = {
        "x_mm": (-lateral, lateral),
        "y_mm": (-lateral, lateral),
        "yaw_deg": (-ranges.yaw_deg, ranges.yaw_deg),
        "depth_mm": (ranges.depth_min_mm, ranges.depth_max_mm),
        "edge_mm": (-edge, edge),
        "edge_deg": (-edge_deg, edge_deg),
        "tilt_x_deg": (-ranges.tilt_deg, ranges.tilt_deg),
        "tilt_y_deg": (-ranges.tilt_deg, ranges.tilt_deg),
    }
    return _make_targets(texts, defaults, SIMULATED_FIELDS, spans)


def make_label_targets(
    texts: Sequence[str],
    poses: np.ndarray,
    moves: np.ndarray | None = None,
    others: Mapping[str, np.ndarray] | None = None,
) -> Targets:
    """Make the targets of recorded contacts; without texts, all columns of the pose that vary.

    Raises UserError for a text that is no target, or whose target does not vary.

    Args:
        poses: labels (N, 6) mm and deg of the training contacts, NaN where unknown.
        moves: of their slides (N, 6) mm and deg.
        others: further columns (N,) of the tables by name.
    """
    others, spans = others or {}, {}
    is_labelled = np.isfinite(poses).all(axis=1)
    if not is_labelled.any() and not list_column_names(texts):
        return ()
    moves = np.zeros_like(poses) if moves is None else moves
    labels = np.concatenate([poses, moves], axis=1)[is_labelled]
    fields = RECORDED_FIELDS | LABELLED_SLIDES
    if len(labels):
        spans = _compute_spans(fields, labels)
    for name, values in others.items():
        known = values[np.isfinite(values)]
        if is_class(name) and ((known % 1 != 0) | (known < 0) | (known >= MAX_CLASSES)).any():
            if name in list_column_names(texts):
                raise UserError(
                    f"target '{name}': a class is an integer from 0 to {MAX_CLASSES - 1}: "
                    "number the classes of that column, or give it another name"
                )
            continue
        if known.size:
            spans[name] = (float(known.min()), float(known.max()))
    fields |= {name: (OTHERS, i) for i, name in enumerate(others)}
    return _make_targets(texts, tuple(RECORDED_FIELDS), fields, spans)


def make_slide_targets(ranges: Ranges) -> Targets:
    """Make targets of what varies between the slides of a simulated set."""
    move, twist = (-ranges.move_mm, ranges.move_mm), (-ranges.twist_deg, ranges.twist_deg)
    spans = dict(zip(SENSOR_SLIDES, (move, move, twist), strict=True))
    return _make_targets((), tuple(SENSOR_SLIDES), SENSOR_SLIDES, spans)


def make_move_targets(moves: np.ndarray) -> Targets:
    """Make targets of what varies between recorded slides (N, 6) mm and deg, NaN where unknown."""
    labels = moves[np.isfinite(moves).all(axis=1)]
    if not len(labels):
        return ()
    spans = _compute_spans(LABELLED_SLIDES, labels)
    return _make_targets((), tuple(LABELLED_SLIDES), LABELLED_SLIDES, spans)


def _compute_spans(names: Iterable[str], labels: np.ndarray) -> dict[str, tuple[float, float]]:
    """Compute the least and the largest value of each column of labels (N, len(names))."""
    ends = zip(labels.min(axis=0).tolist(), labels.max(axis=0).tolist(), strict=True)
    return dict(zip(names, ends, strict=True))


def list_slide_names(texts: Sequence[str]) -> list[str]:
    """List the names in the texts of targets that are of a recorded slide."""
    names = [text.partition(":")[0] for text in texts]
    return [name for name in names if name in LABELLED_SLIDES]


def list_column_names(texts: Sequence[str]) -> list[str]:
    """List the names in the texts of targets that are of further columns of a recording."""
    names = [text.partition(":")[0] for text in texts]
    known = RECORDED_FIELDS.keys() | LABELLED_SLIDES.keys()
    return [name for name in names if name not in known and not name.endswith(("_mm", "_deg"))]


def locate_targets(targets: Targets, columns: Sequence[str]) -> Targets:
    """Give targets that are further columns their places among `columns`. Raises UserError."""
    located = []
    for target in targets:
        if target.field == OTHERS:
            if target.name not in columns:
                raise UserError(f"target '{target.name}': these recordings have no such column")
            target = replace(target, column=columns.index(target.name))
        located.append(target)
    return tuple(located)


def is_class(name: str) -> bool:
    """Return whether a target of this name is a class."""
    return name.endswith(CLASS)


def get_unit(name: str) -> str:
    """Get the unit of a target, mm or deg; "1" for a further column, as `force_x`."""
    unit = name.rpartition("_")[2]
    return unit if unit in ("mm", "deg") else "1"


def _make_targets(
    texts: Sequence[str],
    defaults: Sequence[str],
    fields: Mapping[str, tuple[str, int]],
    spans: Mapping[str, tuple[float, float]],
) -> Targets:
    """Make the targets that `texts` name, or else those of `defaults` that vary.

    Args:
        fields: name: field of a batch, and column in it.
        spans: name: least and largest label, mm or deg.
    """
    targets = []
    for text in texts or defaults:
        name, kind, weight = parse_target(text, fields)
        low, high = spans.get(name, (0.0, 0.0))
        if high - low <= MIN_VARIATION:
            if texts:
                raise UserError(f"target '{name}' does not vary in this data set: leave it out")
            continue
        is_circular = kind == CIRCLE or (
            kind is None and name.endswith("_deg") and high - low > FULL_CIRCLE_DEG
        )
        middle, reach = (0.0, 1.0) if is_circular else ((low + high) / 2, (high - low) / 2)
        classes = int(high) + 1 if is_class(name) else 0
        targets.append(Target(name, *fields[name], middle, reach, is_circular, weight, classes))
    return tuple(targets)


def name_pose_field(task: int) -> str:
    """Name the field with the poses of one of several tasks, NaN in contacts of another."""
    return f"{TASK_POSE}{task}"


def are_of_tasks(targets: Targets) -> bool:
    """Return whether targets are of several tasks, so that a contact has labels of some alone."""
    return any(target.field.startswith(TASK_POSE) for target in targets)


def list_label_fields(targets: Targets) -> tuple[str, ...]:
    """List the fields of a batch that hold the labels."""
    return tuple(dict.fromkeys(target.field for target in targets))


def list_target_names(targets: Targets) -> tuple[str, ...]:
    return tuple(target.name for target in targets)


def read_true_values(targets: Targets, batch: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Read the labels (B,) by name, from a batch with the fields of `list_label_fields`."""
    return {target.name: batch[target.field][:, target.column] for target in targets}


def to_json(targets: Targets) -> list[Json]:
    return [asdict(target) for target in targets]


def from_json(stored: Any, source: str) -> Targets:
    """Read the targets that `to_json` wrote. Raises UserError."""
    try:
        return tuple(Target(**each) for each in stored)
    except TypeError as error:
        raise UserError(
            f"{source} states no pose targets that this version knows: train again"
        ) from error
