"""Symmetries of the dome as it is used, compared pin by pin.

Scenes are turned, mirrored, split in two, tilted, and moved across an edge. Pin errors are in px of
the default camera's 256-px frame, the largest of any pin.
"""

from dataclasses import replace

import numpy as np

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.contacts import Contacts
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.level import LEVELS, Level
from jaxunshear.simulator.paths import DEPTH, TILT_X, YAW, Paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.simulate import follow
from verification.pin_distance import compute_pin_distance
from verification.verification_rows import Row, Rows

GROUP = "the dome"
FINE = "fine tolerance"
# solved so well that the remaining error is the model's; scenes are not turned to a common side, as
# that would hide it
EXACT = replace(
    LEVELS["auto"], tolerance=0.003, limit=20000, precision="float64", omit=("untouched", "nodes")
)
EDGE = "edge"  # a straight one
FLAT_MM = 30.0  # inside the edge: no contact reaches it
FRICTION = 0.7
Points = np.ndarray | list[np.ndarray]  # (B, K, 6)


def make_paths(points: Points, friction: float = FRICTION) -> Paths:
    return Paths(
        np.zeros(len(points), int), np.full(len(points), friction), np.asarray(points, float)
    )


def _solve_ends(
    sensor: Sensor, points: Points, level: str | Level = EXACT, friction: float = FRICTION
) -> Contacts:
    return follow(sensor, (EDGE,), make_paths(points, friction), level)[0]


def _make_rotation(degrees: float) -> np.ndarray:
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def make_slide(
    x: float,
    y: float,
    move: tuple[float, float],
    yaw: float = 0.0,
    depth: float = 2.5,
    twist: float = 0.0,
) -> np.ndarray:
    """Make points (3, 6): down at (x, y) - move, then along `move` and around by `twist` deg."""
    points = np.zeros((3, 6))
    points[:, :2] = np.array([x, y]) - move
    points[2, :2] = x, y
    points[:, YAW] = yaw, yaw, yaw + twist
    points[1:, DEPTH] = depth
    return points


class DomeRows(Rows):
    """Rows of contacts, all of which must have converged."""

    def __init__(self, ends: Contacts | None = None) -> None:
        super().__init__(GROUP, ends is None or bool(ends.converged.all()))

    def expect_same_pins(
        self, problem: str, px: np.ndarray, bar: float | None, note: str = ""
    ) -> None:
        """Add a row of the largest distance of any pin."""
        self.expect_zero(f"{problem}, px", px.max(), 1.0, bar, note=note, px=True)


def check_rotation(sensor: Sensor) -> list[Row]:
    """Check that a sensor turned about its axis over an edge has the same skin, turned."""
    angles = (0.0, 60.0, 17.0)
    ends = _solve_ends(sensor, [make_slide(-1.0, 0.0, (0.8, 1.5), yaw) for yaw in angles])
    still = ends.pins[0]
    turned = (still @ _make_rotation(-60.0).T)[make_sixfold_permutations(sensor.pins)[1]]
    sixth = compute_pin_distance(sensor, ends.pins[1], turned)
    other = compute_pin_distance(sensor, ends.pins[2], _interpolate_turned(sensor, still, -17.0))
    outer = np.arange(sensor.pins) > 3 * 3 * 4  # rings with enough pins to interpolate between
    force = _make_rotation(angles[2]) @ ends.force_n[2] - ends.force_n[0]
    note = "the contact nodes' lattice; pins from the 4th ring on, interpolated"
    words = "slide over an edge, all turned by 17 deg: change of the force"
    size = float(np.linalg.norm(ends.force_n[0]))
    rows = DomeRows(ends)
    rows.expect_same_pins("slide over an edge, all turned by 60 deg", sixth, 0.02, FINE)
    rows.expect_same_pins("slide over an edge, all turned by 17 deg", other[outer], None, note)
    rows.expect_zero(words, float(np.linalg.norm(force)), size, 0.01)
    return rows


def _interpolate_turned(sensor: Sensor, pins: np.ndarray, degrees: float) -> np.ndarray:
    """Compute the pins (P, 3) of a sensor that is turned by -`degrees`.

    Their displacements are interpolated around each ring by its harmonics.
    """
    field = pins - compute_pin_tips(sensor)
    turned, start = np.zeros_like(pins), 0
    for ring in range(sensor.rings + 1):
        size = max(6 * ring, 1)
        angle = 2 * np.pi * np.arange(size) / size
        waves = np.fft.rfft(_turn_each(field[start : start + size], -angle), axis=0)
        shift = np.exp(-1j * np.arange(len(waves)) * np.radians(degrees))[:, None]
        moved = np.fft.irfft(waves * shift, size, axis=0)
        turned[start : start + size] = _turn_each(moved, angle)
        start += size
    return turned + compute_pin_tips(sensor)


def _turn_each(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], -1)


def check_mirroring(sensor: Sensor) -> list[Row]:
    slides = [make_slide(-1.0, 0.0, (0.8, side * 1.0), twist=side * 25.0) for side in (1, -1)]
    ends = _solve_ends(sensor, slides)
    tips = compute_pin_tips(sensor)
    mirrored = np.linalg.norm((tips * [1, -1, 1])[:, None] - tips[None], axis=-1).argmin(1)
    distance = compute_pin_distance(sensor, ends.pins[0] * [1, -1, 1], ends.pins[1][mirrored])
    rows = DomeRows(ends)
    words = "slide with a twist to the right against to the left"
    rows.expect_same_pins(words, distance, 0.02, FINE)
    return rows


def check_resuming(sensor: Sensor) -> list[Row]:
    """Check that a motion in two calls ends as in one."""
    shallow = make_slide(-1.0, 0.0, (0.8, 1.5), depth=2.0)
    deep = make_slide(-1.0, 0.0, (0.8, 1.5), depth=3.5, twist=15.0)
    full = np.array([shallow, deep])
    rows = DomeRows()
    for level, bar, note in (("auto", 0.1, ""), (EXACT, 0.02, FINE)):
        at_once, _ = follow(sensor, (EDGE,), make_paths(full), level)
        _, pressed = follow(sensor, (EDGE,), make_paths(full[:, :2]), level)
        later, _ = follow(sensor, (EDGE,), make_paths(full[:, 1:]), level, pressed)
        distance = compute_pin_distance(sensor, at_once.pins, later.pins)
        rows.settled = bool(at_once.converged.all() and later.converged.all())
        words = "press and slide in one call against in two"
        rows.expect_same_pins(words, distance, bar, note)
    return rows


def check_frictionless(sensor: Sensor) -> list[Row]:
    """Check that without friction only the end of a path counts.

    The increments differ in where they searched for the edge.
    """
    end = make_slide(-1.0, 0.5, (0.0, 0.0), yaw=10.0)
    roundabout = make_slide(-1.0, 0.5, (2.0, -1.5), yaw=-20.0, twist=30.0)
    ends = _solve_ends(sensor, [end, roundabout], friction=0.0)
    distance = compute_pin_distance(sensor, ends.pins[0], ends.pins[1])
    rows = DomeRows(ends)
    words = "no friction: pressed straight down against from the side"
    rows.expect_same_pins(words, distance, 0.1, FINE)
    return rows


def check_edge_sweep(sensor: Sensor) -> list[Row]:
    """Check that no pin jumps where nodes begin to touch: ends 0.05 mm apart at an edge."""
    places = np.arange(-3.0, 3.0 + 1e-9, 0.05)
    rows: list[Row] = []
    for words, move, yaw in (
        ("taps", (0.0, 0.0), 0.0),
        ("slides of 1.5 mm along it", (0.0, 1.5), 10.0),
    ):
        motions = [make_slide(x, 0.0, move, yaw, depth=3.0) for x in places]
        ends = _solve_ends(sensor, motions, "auto")
        pins = ends.pins.astype(float)
        step = compute_pin_distance(sensor, pins[1:], pins[:-1])
        change = compute_pin_distance(sensor, pins[2:] + pins[:-2] - pins[1:-1], pins[1:-1])
        passed = DomeRows(ends)
        passed.expect_same_pins(f"edge passed in steps of 0.05 mm by {words}: step", step, None)
        words = f"edge passed by {words}: step against the step before"
        passed.expect_same_pins(words, change, 0.3)
        rows += passed
    return rows


def check_tilt(sensor: Sensor) -> list[Row]:
    """Check tilted slides and presses on the flat, where another place of the dome touches.

    It differs only in the lattice of the nodes, and in its distance from the clamp at the base.
    """
    points = []
    for direction in (0.0, 60.0, 17.0):
        along = _make_rotation(direction)[:2, :2]
        point = make_slide(-FLAT_MM, 0.0, tuple(along @ [1.0, 0.0]))
        point[:, TILT_X:] = along @ [0.0, 20.0]
        points.append(point)
    ends = _solve_ends(sensor, points)
    force = np.linalg.norm(ends.force_n, axis=-1)
    turned_back = ends.pins[1][make_sixfold_permutations(sensor.pins)[1]]
    sixth = compute_pin_distance(sensor, turned_back, ends.pins[0] @ _make_rotation(60.0).T)
    rows = DomeRows(ends)
    words = "slide on the flat, tilted by 20 deg, turned by"
    rows.expect_same_pins(f"{words} 60 deg", sixth, 0.02, FINE)
    words += " 17 deg: change of the force"
    rows.expect_zero(words, force[2] - force[0], force[0], 0.01)
    tilts = (0.0, 10.0, 20.0)
    presses = np.array([make_slide(-FLAT_MM, 0.0, (0.0, 0.0)) for _ in tilts])
    presses[:, :, TILT_X + 1] = np.array(tilts)[:, None]
    ends = _solve_ends(sensor, presses, friction=0.0)
    force = np.linalg.norm(ends.force_n, axis=-1)
    rows.settled = bool(ends.converged.all())
    for tilt, change in zip(tilts[1:], force[1:] - force[0], strict=True):
        words = f"frictionless press on the flat, tilted by {tilt:g} deg: change of the force"
        rows.expect_zero(words, change, force[0], 0.03)
    return rows
