"""The dome as it is used: scenes turned, mirrored, split in two, tilted, and moved across an edge, compared pin by pin.

Pin errors are in px of the default camera's 256-px frame, the largest of any pin.
"""

from dataclasses import replace

import numpy as np

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.contact_results import Contacts
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.level import LEVELS, Level
from jaxunshear.simulator.paths import DEPTH, TILT_X, YAW, Paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.simulate import follow
from verification.pin_distance import compute_pin_distance
from verification.verification_rows import Row, make_zero_row

GROUP = "the dome"
FINE = "fine tolerance"
# solved so well that what is left is the model's; scenes are not turned to a common side, as that would be the answer
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


def _rotation(degrees: float) -> np.ndarray:
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
    """(3, 6): down at (x, y) - move with this yaw, then along `move` and around by `twist` deg."""
    points = np.zeros((3, 6))
    points[:, :2] = np.array([x, y]) - move
    points[2, :2] = x, y
    points[:, YAW] = yaw, yaw, yaw + twist
    points[1:, DEPTH] = depth
    return points


def check_rotation(sensor: Sensor) -> list[Row]:
    """The sensor turned about its axis over an edge: the same skin, seen from another side."""
    angles = (0.0, 60.0, 17.0)
    made = _solve_ends(sensor, [make_slide(-1.0, 0.0, (0.8, 1.5), yaw) for yaw in angles])
    still = made.pins[0]
    sixth = compute_pin_distance(
        sensor,
        made.pins[1],
        (still @ _rotation(-60.0).T)[make_sixfold_permutations(sensor.pins)[1]],
    )
    other = compute_pin_distance(sensor, made.pins[2], _at_angles(sensor, still, -17.0))
    outer = np.arange(sensor.pins) > 3 * 3 * 4  # rings with enough pins to interpolate between
    force = _rotation(angles[2]) @ made.force_n[2] - made.force_n[0]
    note = "the contact nodes' lattice; pins from the 4th ring on, interpolated"
    words = "slide over an edge, all turned by 17 deg: change of the force"
    size = float(np.linalg.norm(made.force_n[0]))
    good = bool(made.converged.all())
    return [
        _px("slide over an edge, all turned by 60 deg", sixth, 0.02, good, FINE),
        _px("slide over an edge, all turned by 17 deg", other[outer], None, good, note),
        make_zero_row(GROUP, words, float(np.linalg.norm(force)), size, 0.01, settled=good),
    ]


def _at_angles(sensor: Sensor, pins: np.ndarray, degrees: float) -> np.ndarray:
    """Pins (P, 3) of a sensor that is turned by -`degrees`: their field, interpolated around each ring by its harmonics."""
    field = pins - compute_pin_tips(sensor)
    made, start = np.zeros_like(pins), 0
    for ring in range(sensor.rings + 1):
        size = max(6 * ring, 1)
        angle = 2 * np.pi * np.arange(size) / size
        waves = np.fft.rfft(_polar(field[start : start + size], -angle), axis=0)
        shift = np.exp(-1j * np.arange(len(waves)) * np.radians(degrees))[:, None]
        moved = np.fft.irfft(waves * shift, size, axis=0)
        made[start : start + size] = _polar(moved, angle)
        start += size
    return made + compute_pin_tips(sensor)


def _polar(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], -1)


def check_mirroring(sensor: Sensor) -> list[Row]:
    made = _solve_ends(
        sensor, [make_slide(-1.0, 0.0, (0.8, side * 1.0), twist=side * 25.0) for side in (1, -1)]
    )
    tips = compute_pin_tips(sensor)
    partner = np.linalg.norm((tips * [1, -1, 1])[:, None] - tips[None], axis=-1).argmin(1)
    apart = compute_pin_distance(sensor, made.pins[0] * [1, -1, 1], made.pins[1][partner])
    return [
        _px(
            "slide with a twist to the right against to the left",
            apart,
            0.02,
            bool(made.converged.all()),
            FINE,
        )
    ]


def check_resuming(sensor: Sensor) -> list[Row]:
    """One motion in two calls."""
    full = np.array(
        [
            make_slide(-1.0, 0.0, (0.8, 1.5), depth=depth, twist=twist)
            for depth, twist in ((2.0, 0.0), (3.5, 15.0))
        ]
    )
    rows = []
    for level, bar, note in (("auto", 0.1, ""), (EXACT, 0.02, FINE)):
        at_once, _ = follow(sensor, (EDGE,), make_paths(full), level)
        _, pressed = follow(sensor, (EDGE,), make_paths(full[:, :2]), level)
        later, _ = follow(sensor, (EDGE,), make_paths(full[:, 1:]), level, pressed)
        apart = compute_pin_distance(sensor, at_once.pins, later.pins)
        good = bool(at_once.converged.all() and later.converged.all())
        rows.append(_px("press and slide in one call against in two", apart, bar, good, note))
    return rows


def check_frictionless(sensor: Sensor) -> list[Row]:
    """Without friction only the end of a path counts, up to where each increment searched for the edge."""
    end = make_slide(-1.0, 0.5, (0.0, 0.0), yaw=10.0)
    roundabout = make_slide(-1.0, 0.5, (2.0, -1.5), yaw=-20.0, twist=30.0)
    made = _solve_ends(sensor, [end, roundabout], friction=0.0)
    apart = compute_pin_distance(sensor, made.pins[0], made.pins[1])
    return [
        _px(
            "no friction: pressed straight down against from the side",
            apart,
            0.1,
            bool(made.converged.all()),
            FINE,
        )
    ]


def check_edge_sweep(sensor: Sensor) -> list[Row]:
    """Ends 0.05 mm apart across an edge, taps and slides: does a node that comes to touch make a pin jump?"""
    places = np.arange(-3.0, 3.0 + 1e-9, 0.05)
    rows = []
    for words, move, yaw in (
        ("taps", (0.0, 0.0), 0.0),
        ("slides of 1.5 mm along it", (0.0, 1.5), 10.0),
    ):
        made = _solve_ends(
            sensor, [make_slide(x, 0.0, move, yaw, depth=3.0) for x in places], "auto"
        )
        pins, good = made.pins.astype(float), bool(made.converged.all())
        step = compute_pin_distance(sensor, pins[1:], pins[:-1])
        change = compute_pin_distance(sensor, pins[2:] + pins[:-2] - pins[1:-1], pins[1:-1])
        rows += [
            _px(f"edge passed in steps of 0.05 mm by {words}: step", step, None, good),
            _px(f"edge passed by {words}: step against the step before", change, 0.3, good),
        ]
    return rows


def check_tilt(sensor: Sensor) -> list[Row]:
    """A tilt on the flat brings another place of the dome into contact: alike, but for the lattice and the clamp at its base."""
    points = []
    for direction in (0.0, 60.0, 17.0):
        along = _rotation(direction)[:2, :2]
        point = make_slide(-FLAT_MM, 0.0, tuple(along @ [1.0, 0.0]))
        point[:, TILT_X:] = along @ [0.0, 20.0]
        points.append(point)
    made = _solve_ends(sensor, points)
    force = np.linalg.norm(made.force_n, axis=-1)
    sixth = compute_pin_distance(
        sensor,
        made.pins[1][make_sixfold_permutations(sensor.pins)[1]],
        made.pins[0] @ _rotation(60.0).T,
    )
    words = "slide on the flat, tilted by 20 deg, turned by 17 deg: change of the force"
    good = bool(made.converged.all())
    rows = [
        _px("slide on the flat, tilted by 20 deg, turned by 60 deg", sixth, 0.02, good, FINE),
        make_zero_row(GROUP, words, force[2] - force[0], force[0], 0.01, settled=good),
    ]
    tilts = (0.0, 10.0, 20.0)
    presses = np.array([make_slide(-FLAT_MM, 0.0, (0.0, 0.0)) for _ in tilts])
    presses[:, :, TILT_X + 1] = np.array(tilts)[:, None]
    made = _solve_ends(sensor, presses, friction=0.0)
    force = np.linalg.norm(made.force_n, axis=-1)
    for tilt, here in zip(tilts[1:], force[1:], strict=True):
        words = f"frictionless press on the flat, tilted by {tilt:g} deg: change of the force"
        rows.append(
            make_zero_row(
                GROUP, words, here - force[0], force[0], 0.03, settled=bool(made.converged.all())
            )
        )
    return rows


def _px(problem: str, apart: np.ndarray, bar: float | None, settled: bool, note: str = "") -> Row:
    return make_zero_row(
        GROUP, f"{problem}, px", apart.max(), 1.0, bar, settled=settled, note=note, px=True
    )
