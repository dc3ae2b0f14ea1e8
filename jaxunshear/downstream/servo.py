"""Contour following in the simulator: the sensor slides around an object and steers by what it feels.

The contact keeps its history from step to step, so shear builds up as on a robot, twist included. All walks, of all ways of perceiving
and from all starts, go side by side, one batch of contacts a step.

Read `_take_step` first: contact -> image -> perception -> controller -> next way point.
"""

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.angles import rotate_2d
from jaxunshear.config.configs import VERSION
from jaxunshear.config.data import PairedData
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.stimuli import Outline, StimulusSetting
from jaxunshear.data.chunks import RENDER_BATCH, pack_bits, render_images
from jaxunshear.downstream.contour import Contour, trace_contour, update_arc_positions
from jaxunshear.downstream.controller import ControllerGains, ControllerState, control
from jaxunshear.errors import UserError
from jaxunshear.files import BROKEN_NPZ, read_npz, write_npz
from jaxunshear.inference.perception import EdgeEstimator
from jaxunshear.progress import Progress
from jaxunshear.simulator.contact_results import Skins
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.scene import make_edge_labeler
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import make_stimulus

MAX_EDGE_DISTANCE_MM = 8.0  # from the edge: farther than any network has seen
WINDOW_MM = 3.0  # along the outline, in which a sensor is searched for after a step
MAX_FAILURES_IN_ROW = 5  # contacts in a row that may fail to converge
SAVE_EVERY = 50  # steps

ENDS = (
    "walking",
    "closed",
    "lost the edge",
    "lost contact",
    "contacts did not converge",
    "took too long",
)
WALKING, CLOSED, LOST, UNTOUCHED, UNSTABLE, LATE = range(6)


@dataclass(frozen=True)
class ServoTask:
    """Where and how the walks go."""

    stimulus: StimulusSetting
    starts: int = 5
    depth_mm: float = 3.0
    start_offset_mm: float = 1.0  # starts lie within this of the edge, at random,
    start_rotation_deg: float = 10.0  # and are turned by as much
    seed: int = 0
    gains: ControllerGains = field(default_factory=ControllerGains)
    max_outline_lengths: float = 1.6  # outlines' lengths that a walk may take


@dataclass
class Trajectories:
    """W walks of up to T steps (numpy), one row for each way of perceiving and start; NaN after a walk's end."""

    method: np.ndarray  # (W,) names
    start: np.ndarray  # (W,) which of the starts
    point: np.ndarray  # (W, T, 3) x, y mm and yaw deg of the sensor, target frame
    perceived: (
        np.ndarray
    )  # (W, T, 2) the edge's distance mm and direction deg in the sensor frame, as perceived
    true: np.ndarray  # (W, T, 2) the same as it is
    images: np.ndarray  # (W, T, bytes) what the camera saw, one bit a pixel
    arc_mm: np.ndarray  # (W,) where along the outline
    way_mm: np.ndarray  # (W,) how far along it since the start
    end: np.ndarray  # (W,) index into ENDS
    failed_contacts: np.ndarray  # (W,) contacts that did not converge
    failures_in_row: np.ndarray  # (W,) of these the latest in a row
    force_n: np.ndarray  # (W, N, 3) on the contact nodes: the skins' memory
    sums: np.ndarray  # (2, W) the controllers' memory
    perceive_s: np.ndarray  # (W,) spent so far
    simulate_s: np.ndarray  # () spent so far
    steps: np.ndarray  # () done
    provenance: np.ndarray  # () text: `compute_servo_digest`


def follow_contour(
    task: ServoTask,
    sensor: Sensor,
    settings: PairedData,
    methods: Mapping[str, EdgeEstimator | None],
    file: Path | None = None,
    digests: Mapping[str, str] = MappingProxyType({}),
) -> tuple[Trajectories, Contour]:
    """Walks from every start by every way of perceiving (None: the true pose), until each has closed the outline or come to grief.

    `settings` say how camera and image are. The walks are kept in `file` now and then, and in the end; the same call
    goes on from there. None: nowhere.
    `digests` of the networks of each way identify walks of other networks.
    """
    stimulus = make_stimulus(task.stimulus)
    line = trace_contour(stimulus)
    made = compute_servo_digest(sensor, settings, digests)
    walks = _load_matching_trajectories(file, task, tuple(methods), made) or _make_trajectories(
        task, line, tuple(methods), settings, made
    )
    total = walks.point.shape[1]
    steer, report = jax.jit(control, static_argnums=0), make_edge_labeler(stimulus)
    with Progress(f"servo {task.stimulus}", total, "steps", done=int(walks.steps)) as progress:
        while walks.steps < total and np.any(walks.end == WALKING):
            _take_step(walks, task, sensor, settings, line, methods, steer, report)
            progress.advance()
            if walks.steps % SAVE_EVERY == 0:
                _store(file, task, walks)
        progress.total = float(walks.steps)  # all have come to an end before their time
    walks.end[walks.end == WALKING] = LATE
    _store(file, task, walks)
    return walks, line


def compute_servo_digest(sensor: Sensor, settings: PairedData, digests: Mapping[str, str]) -> str:
    """A digest of all but the course that decides walks: simulator, sensor, how images are made of it, the networks of each way."""
    seen = {
        name: dataclasses.asdict(getattr(settings, name))
        for name in ("camera", "nuisance", "preprocess")
    }
    contact = {
        "version": VERSION,
        "sensor": dataclasses.asdict(sensor),
        "friction": settings.friction,
    }
    full = {**contact, **seen, "seed": settings.seed, "networks": dict(digests)}
    return hashlib.sha256(json.dumps(full, sort_keys=True).encode()).hexdigest()[:16]


def sample_start_points(course: ServoTask, line: Contour) -> np.ndarray:
    """(starts, 3) x, y, yaw: evenly around the outline, then off it and turned by random amounts."""
    generator = np.random.default_rng([course.seed, 5])
    place = line.at((np.arange(course.starts) + generator.uniform()) * line.length / course.starts)
    aside = generator.uniform(-course.start_offset_mm, course.start_offset_mm, course.starts)
    turned = generator.uniform(-course.start_rotation_deg, course.start_rotation_deg, course.starts)
    normal = line.normal[place]
    yaw = np.degrees(np.arctan2(normal[:, 1], normal[:, 0]))
    return np.column_stack([line.points[place] + aside[:, None] * normal, yaw + turned])


def _make_trajectories(
    course: ServoTask, line: Contour, ways: tuple[str, ...], settings: PairedData, made: str
) -> Trajectories:
    count = len(ways) * course.starts
    total = int(np.ceil(course.max_outline_lengths * line.length / course.gains.step_mm))
    size = settings.preprocess.size
    point = np.full((count, total, 3), np.nan)
    point[:, 0] = np.tile(sample_start_points(course, line), (len(ways), 1))
    nowhere = np.full((count, total, 2), np.nan)
    nearest = np.argmin(np.linalg.norm(line.points - point[:, 0, None, :2], axis=-1), axis=1)
    zero = np.zeros(count)
    return Trajectories(
        method=np.repeat(ways, course.starts),
        start=np.tile(np.arange(course.starts), len(ways)),
        point=point,
        perceived=nowhere,
        true=nowhere.copy(),
        images=np.zeros((count, total, -(-size * size // 8)), np.uint8),
        arc_mm=nearest * line.length / len(line.points),
        way_mm=zero.copy(),
        end=np.full(count, WALKING),
        failed_contacts=zero.astype(int),
        failures_in_row=zero.astype(int),
        force_n=np.zeros((count, 0, 3)),
        sums=np.zeros((2, count)),
        perceive_s=zero.copy(),
        simulate_s=np.array(0.0),
        steps=np.array(0),
        provenance=np.array(made),
    )


def _take_step(
    walks: Trajectories,
    course: ServoTask,
    sensor: Sensor,
    settings: PairedData,
    line: Contour,
    ways: Mapping[str, EdgeEstimator | None],
    steer: Callable,
    report: Callable,
) -> None:
    step, rows = int(walks.steps), np.flatnonzero(walks.end == WALKING)
    images, ended = _touch(walks, course, sensor, settings, step, rows)
    walks.images[:, step] = pack_bits(images)
    here = walks.point[:, step]
    walks.true[:, step] = report(here)
    _perceive(walks, ways, images, step, rows)

    walks.arc_mm[rows], before = (
        update_arc_positions(line, walks.arc_mm[rows], here[rows, :2], WINDOW_MM),
        walks.arc_mm[rows],
    )
    walks.way_mm[rows] += walks.arc_mm[rows] - before
    ended[np.abs(walks.true[:, step, 0]) > MAX_EDGE_DISTANCE_MM] = LOST
    ended[(walks.way_mm >= line.length) & (ended == WALKING)] = CLOSED
    walks.end[rows] = ended[rows]

    seen = jnp.asarray(np.nan_to_num(walks.perceived[:, step]), jnp.float32)
    move, turn, memory = steer(
        course.gains, ControllerState(*jnp.asarray(walks.sums, jnp.float32)), seen[:, 0], seen[:, 1]
    )
    walks.sums[:] = np.asarray(memory)
    walks.steps += 1
    going = rows[ended[rows] == WALKING]
    if walks.steps < walks.point.shape[1]:
        walks.point[going, step + 1] = _apply_motion(
            here[going], np.asarray(move)[going], np.asarray(turn)[going]
        )


def _touch(
    walks: Trajectories,
    course: ServoTask,
    sensor: Sensor,
    settings: PairedData,
    step: int,
    rows: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Moves the walks `rows` on to this step's points: images (W, S, S), and how the contact ends a walk (W,)."""
    began = time.perf_counter()
    count, own = len(walks.method), make_stimulus(course.stimulus).friction
    friction = own if settings.friction is None else settings.friction
    points = np.zeros((len(rows), 2, 6))
    points[:, 0, :3] = walks.point[rows, max(step - 1, 0)]
    points[:, 1, :3] = walks.point[rows, step]
    points[..., 3] = course.depth_mm
    before = None
    if step == 0:
        points[:, 0, 3] = 0
    else:
        before = Skins(walks.force_n[rows], points[:, 0])
    paths = Paths(np.zeros(len(rows), int), np.full(len(rows), friction), points)
    contacts, skins = follow(sensor, (course.stimulus,), paths, start=before)
    if step == 0:
        walks.force_n = np.zeros((count, *skins.force_n.shape[1:]))
    walks.force_n[rows] = skins.force_n

    ended = np.full(count, WALKING)
    ended[rows[contacts.stuck_nodes + contacts.slipping_nodes == 0]] = UNTOUCHED
    walks.failed_contacts[rows] += ~contacts.converged
    walks.failures_in_row[rows] = np.where(contacts.converged, 0, walks.failures_in_row[rows] + 1)
    finite = np.isfinite(contacts.pins).all(axis=(1, 2))
    ended[rows[(walks.failures_in_row[rows] >= MAX_FAILURES_IN_ROW) | ~finite]] = UNSTABLE

    size = settings.preprocess.size
    images = np.zeros((count, size, size), np.uint8)
    number = step * count + rows  # every frame has noise of its own
    seen = rows[finite]
    if len(seen):
        fresh, few = np.zeros(len(seen)), min(RENDER_BATCH, count)
        images[seen] = render_images(
            settings, sensor, contacts.pins[finite], number[finite], fresh, few
        )[0]
    walks.simulate_s += time.perf_counter() - began
    return images, ended


def _perceive(
    walks: Trajectories,
    ways: Mapping[str, EdgeEstimator | None],
    images: np.ndarray,
    step: int,
    rows: np.ndarray,
) -> None:
    walking = np.zeros(len(walks.method), bool)
    walking[rows] = True
    for way, perceive in ways.items():
        mine = np.flatnonzero(walks.method == way)
        if not walking[mine].any():
            continue
        began = time.perf_counter()
        seen = walks.true[mine, step] if perceive is None else np.stack(perceive(images[mine]), -1)
        walks.perceive_s[mine] += (time.perf_counter() - began) / len(mine)
        walks.perceived[mine, step] = np.where(walking[mine, None], seen, np.nan)


def _apply_motion(point: np.ndarray, move: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Points (B, 3) after moves (B, 2) and turns (B,) in the sensor frame."""
    return point + np.column_stack([rotate_2d(move, np.radians(point[:, 2])), turn])


def load_trajectories(file: Path) -> tuple[ServoTask, Trajectories]:
    """What `follow_contour` kept in a file. Raises `UserError` where it is damaged."""
    try:
        kept = read_npz(file)
        asked = json.loads(str(kept.pop("course")))
        touched = asked["stimulus"]
        own = {
            "stimulus": touched if isinstance(touched, str) else Outline(**touched),
            "gains": ControllerGains(**asked["gains"]),
        }
        return ServoTask(**asked | own), Trajectories(**kept)
    except (*BROKEN_NPZ, TypeError) as error:
        raise UserError(
            f"{file} cannot be read ({error}): delete it and run the same command again"
        ) from error


def _store(file: Path | None, course: ServoTask, walks: Trajectories) -> None:
    if file is not None:
        write_npz(file, {"course": np.array(json.dumps(dataclasses.asdict(course)))} | vars(walks))


def _load_matching_trajectories(
    file: Path | None, course: ServoTask, ways: tuple[str, ...], made: str
) -> Trajectories | None:
    if file is None or not file.exists():
        return None
    before, walks = load_trajectories(file)
    if before != course or tuple(dict.fromkeys(walks.method.tolist())) != ways:
        raise UserError(f"{file} holds walks with other settings: give another --out, or delete it")
    if str(walks.provenance) != made:
        raise UserError(
            f"{file} holds walks of another model or sensor, or of an earlier simulator: give another --out, or delete it"
        )
    return walks
