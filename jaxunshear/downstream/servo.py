"""Contour following in the simulator.

The sensor slides around an object and steers by touch. The contact keeps its history from step to
step, so shear and twist build up as on a robot. All trajectories, of all methods of perception and
from all starts, advance side by side: one batch of contacts per step.

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
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.angles import rotate_2d
from jaxunshear.config.data import PairedData
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.stimuli import Outline, StimulusSetting
from jaxunshear.data.chunks import pack_bits
from jaxunshear.data.simulation import RENDER_BATCH, render_images
from jaxunshear.downstream.contour import (
    Command,
    Contour,
    ControllerGains,
    ControllerState,
    control,
    trace_contour,
    update_arc_positions,
)
from jaxunshear.errors import UserError
from jaxunshear.files import BROKEN_NPZ, read_npz, write_npz
from jaxunshear.inference.edge_methods import EdgeEstimator
from jaxunshear.progress import Progress
from jaxunshear.simulator.contacts import Contacts, Skins
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.scene import make_edge_labeler
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import make_stimulus

MAX_EDGE_DISTANCE_MM = 8.0  # farther than in any training data
WINDOW_MM = 3.0  # along the outline, in which the sensor is searched for after a step
MAX_FAILURES_IN_ROW = 5  # contacts that fail to converge
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
    """Which object is followed, and how."""

    stimulus: StimulusSetting
    starts: int = 5
    depth_mm: float = 3.0
    start_offset_mm: float = 1.0  # largest random distance of a start from the edge
    start_rotation_deg: float = 10.0  # largest random rotation of a start
    seed: int = 0
    gains: ControllerGains = field(default_factory=ControllerGains)
    max_outline_lengths: float = 1.6  # longest trajectory, over the outline's length


@dataclass
class Trajectories:
    """W trajectories of up to T steps, one for each method of perception and start.

    Values are NaN after a trajectory's end.
    """

    method: np.ndarray  # (W,) names
    start: np.ndarray  # (W,) number of the start
    point: np.ndarray  # (W, T, 3) x, y mm and yaw deg of the sensor, target frame
    # (W, T, 2) the edge's distance mm and direction deg in the sensor frame, as perceived
    perceived: np.ndarray
    true: np.ndarray  # (W, T, 2) the true values of `perceived`
    images: np.ndarray  # (W, T, bytes) binary images, one bit per pixel
    arc_mm: np.ndarray  # (W,) position along the outline
    way_mm: np.ndarray  # (W,) distance along the outline since the start
    end: np.ndarray  # (W,) index into ENDS
    failed_contacts: np.ndarray  # (W,) contacts that did not converge
    failures_in_row: np.ndarray  # (W,) the latest of them in a row
    force_n: np.ndarray  # (W, N, 3) on the contact nodes: the skins' memory
    sums: np.ndarray  # (2, W) the controllers' state
    perceive_s: np.ndarray  # (W,) time spent so far
    simulate_s: np.ndarray  # () time spent so far
    steps: np.ndarray  # () done
    provenance: np.ndarray  # () text: `compute_servo_digest`

    def list_methods(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self.method.tolist()))


class _Loop(NamedTuple):
    """What stays the same over the steps of a task."""

    task: ServoTask
    sensor: Sensor
    settings: PairedData
    contour: Contour
    methods: Mapping[str, EdgeEstimator | None]
    steer: Callable[..., Command]
    label_edges: Callable[[np.ndarray], np.ndarray]


def follow_contour(
    task: ServoTask,
    sensor: Sensor,
    settings: PairedData,
    methods: Mapping[str, EdgeEstimator | None],
    file: Path | None = None,
    digests: Mapping[str, str] = MappingProxyType({}),
) -> tuple[Trajectories, Contour]:
    """Follow the outline from every start by every method, until each closes it or fails.

    Args:
        settings: Camera, disturbances and preprocessing of the images.
        methods: Estimators of the edge by name; None for the true pose.
        file: Where trajectories are saved from time to time and at the end, if anywhere; the same
            call continues from there.
        digests: Of the networks of each method; they identify trajectories of other networks.
    """
    stimulus = make_stimulus(task.stimulus)
    contour = trace_contour(stimulus)
    steer, label_edges = jax.jit(control, static_argnums=0), make_edge_labeler(stimulus)
    loop = _Loop(task, sensor, settings, contour, methods, steer, label_edges)
    digest = compute_servo_digest(sensor, settings, digests)
    trajectories = _load_matching(file, task, tuple(methods), digest)
    trajectories = trajectories or _make_trajectories(loop, digest)
    total, done = trajectories.point.shape[1], int(trajectories.steps)
    with Progress(f"servo {task.stimulus}", total, "steps", done=done) as progress:
        while trajectories.steps < total and np.any(trajectories.end == WALKING):
            _take_step(loop, trajectories)
            progress.advance()
            if trajectories.steps % SAVE_EVERY == 0:
                _save(file, task, trajectories)
        progress.total = float(trajectories.steps)  # all may have ended early
    trajectories.end[trajectories.end == WALKING] = LATE
    _save(file, task, trajectories)
    return trajectories, contour


def compute_servo_digest(sensor: Sensor, settings: PairedData, digests: Mapping[str, str]) -> str:
    """Compute a digest of all that decides trajectories except the task."""
    content = {
        "version": PairedData.version,
        "sensor": dataclasses.asdict(sensor),
        "friction": settings.friction,
        "camera": dataclasses.asdict(settings.camera),
        "nuisance": dataclasses.asdict(settings.nuisance),
        "preprocess": dataclasses.asdict(settings.preprocess),
        "seed": settings.seed,
        "networks": dict(digests),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def sample_start_points(task: ServoTask, contour: Contour) -> np.ndarray:
    """Sample starts (starts, 3) x, y, yaw: even around the outline, then moved at random."""
    generator = np.random.default_rng([task.seed, 5])
    arc_mm = (np.arange(task.starts) + generator.uniform()) * contour.length / task.starts
    offset = generator.uniform(-task.start_offset_mm, task.start_offset_mm, task.starts)
    rotation = generator.uniform(-task.start_rotation_deg, task.start_rotation_deg, task.starts)
    place = contour.at(arc_mm)
    normal = contour.normal[place]
    yaw = np.degrees(np.arctan2(normal[:, 1], normal[:, 0]))
    return np.column_stack([contour.points[place] + offset[:, None] * normal, yaw + rotation])


def _make_trajectories(loop: _Loop, digest: str) -> Trajectories:
    task, contour, methods = loop.task, loop.contour, tuple(loop.methods)
    count = len(methods) * task.starts
    total = int(np.ceil(task.max_outline_lengths * contour.length / task.gains.step_mm))
    size = loop.settings.preprocess.size
    point = np.full((count, total, 3), np.nan)
    point[:, 0] = np.tile(sample_start_points(task, contour), (len(methods), 1))
    nearest = np.argmin(np.linalg.norm(contour.points - point[:, 0, None, :2], axis=-1), axis=1)
    return Trajectories(
        method=np.repeat(methods, task.starts),
        start=np.tile(np.arange(task.starts), len(methods)),
        point=point,
        perceived=np.full((count, total, 2), np.nan),
        true=np.full((count, total, 2), np.nan),
        images=np.zeros((count, total, -(-size * size // 8)), np.uint8),
        arc_mm=nearest * contour.length / len(contour.points),
        way_mm=np.zeros(count),
        end=np.full(count, WALKING),
        failed_contacts=np.zeros(count, int),
        failures_in_row=np.zeros(count, int),
        force_n=np.zeros((count, 0, 3)),
        sums=np.zeros((2, count)),
        perceive_s=np.zeros(count),
        simulate_s=np.array(0.0),
        steps=np.array(0),
        provenance=np.array(digest),
    )


def _take_step(loop: _Loop, trajectories: Trajectories) -> None:
    step, rows = int(trajectories.steps), np.flatnonzero(trajectories.end == WALKING)
    images, ends = _simulate_step(loop, trajectories, rows)
    trajectories.images[:, step] = pack_bits(images)
    point = trajectories.point[:, step]
    trajectories.true[:, step] = loop.label_edges(point)
    _perceive(loop, trajectories, images, rows)

    before = trajectories.arc_mm[rows]
    arc_mm = update_arc_positions(loop.contour, before, point[rows, :2], WINDOW_MM)
    trajectories.arc_mm[rows] = arc_mm
    trajectories.way_mm[rows] += arc_mm - before
    ends[np.abs(trajectories.true[:, step, 0]) > MAX_EDGE_DISTANCE_MM] = LOST
    ends[(trajectories.way_mm >= loop.contour.length) & (ends == WALKING)] = CLOSED
    trajectories.end[rows] = ends[rows]

    edge = jnp.asarray(np.nan_to_num(trajectories.perceived[:, step]), jnp.float32)
    state = ControllerState(*jnp.asarray(trajectories.sums, jnp.float32))
    move, turn, state = loop.steer(loop.task.gains, state, edge[:, 0], edge[:, 1])
    trajectories.sums[:] = np.asarray(state)
    trajectories.steps += 1
    walking = rows[ends[rows] == WALKING]
    if trajectories.steps < trajectories.point.shape[1]:
        moved = rotate_2d(np.asarray(move)[walking], np.radians(point[walking, 2]))
        motion = np.column_stack([moved, np.asarray(turn)[walking]])
        trajectories.point[walking, step + 1] = point[walking] + motion


def _simulate_step(
    loop: _Loop, trajectories: Trajectories, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move the sensors of `rows` to the points of this step.

    Returns images (W, S, S), and by which of ENDS the contact ends a trajectory (W,).
    """
    start = time.perf_counter()
    step, count = int(trajectories.steps), len(trajectories.method)
    contacts = _simulate_contacts(loop, trajectories, rows)
    ends = np.full(count, WALKING)
    ends[rows[contacts.stuck_nodes + contacts.slipping_nodes == 0]] = UNTOUCHED
    trajectories.failed_contacts[rows] += ~contacts.converged
    failures = np.where(contacts.converged, 0, trajectories.failures_in_row[rows] + 1)
    trajectories.failures_in_row[rows] = failures
    finite = np.isfinite(contacts.pins).all(axis=(1, 2))
    ends[rows[(failures >= MAX_FAILURES_IN_ROW) | ~finite]] = UNSTABLE

    size = loop.settings.preprocess.size
    images = np.zeros((count, size, size), np.uint8)
    rendered = rows[finite]
    if len(rendered):
        numbers = step * count + rendered  # every frame has noise of its own
        age, batch = np.zeros(len(rendered)), min(RENDER_BATCH, count)
        images[rendered] = render_images(
            loop.settings, loop.sensor, contacts.pins[finite], numbers, age, batch
        )[0]
    trajectories.simulate_s += time.perf_counter() - start
    return images, ends


def _simulate_contacts(loop: _Loop, trajectories: Trajectories, rows: np.ndarray) -> Contacts:
    step, stimulus = int(trajectories.steps), loop.task.stimulus
    friction = loop.settings.friction
    if friction is None:
        friction = make_stimulus(stimulus).friction
    points = np.zeros((len(rows), 2, 6))
    points[:, 0, :3] = trajectories.point[rows, max(step - 1, 0)]
    points[:, 1, :3] = trajectories.point[rows, step]
    points[..., 3] = loop.task.depth_mm
    before = None
    if step == 0:
        points[:, 0, 3] = 0
    else:
        before = Skins(trajectories.force_n[rows], points[:, 0])
    paths = Paths(np.zeros(len(rows), int), np.full(len(rows), friction), points)
    contacts, skins = follow(loop.sensor, (stimulus,), paths, start=before)
    if step == 0:
        count = len(trajectories.method)
        trajectories.force_n = np.zeros((count, *skins.force_n.shape[1:]))
    trajectories.force_n[rows] = skins.force_n
    return contacts


def _perceive(
    loop: _Loop, trajectories: Trajectories, images: np.ndarray, rows: np.ndarray
) -> None:
    step = int(trajectories.steps)
    walking = np.zeros(len(trajectories.method), bool)
    walking[rows] = True
    for method, estimate_edge in loop.methods.items():
        batch = np.flatnonzero(trajectories.method == method)
        if not walking[batch].any():
            continue
        start = time.perf_counter()
        edge = trajectories.true[batch, step]
        if estimate_edge is not None:
            edge = np.stack(estimate_edge(images[batch]), -1)
        trajectories.perceive_s[batch] += (time.perf_counter() - start) / len(batch)
        trajectories.perceived[batch, step] = np.where(walking[batch, None], edge, np.nan)


def load_trajectories(file: Path) -> tuple[ServoTask, Trajectories]:
    """Load what `follow_contour` saved in a file. Raises `UserError` if it is damaged."""
    try:
        arrays = read_npz(file)
        fields = json.loads(str(arrays.pop("course")))
        stimulus = fields["stimulus"]
        fields["stimulus"] = stimulus if isinstance(stimulus, str) else Outline(**stimulus)
        fields["gains"] = ControllerGains(**fields["gains"])
        return ServoTask(**fields), Trajectories(**arrays)
    except (*BROKEN_NPZ, TypeError) as error:
        raise UserError(
            f"{file} cannot be read ({error}): delete it and run the same command again"
        ) from error


def _save(file: Path | None, task: ServoTask, trajectories: Trajectories) -> None:
    if file is not None:
        course = json.dumps(dataclasses.asdict(task))
        write_npz(file, {"course": np.array(course)} | vars(trajectories))


def _load_matching(
    file: Path | None, task: ServoTask, methods: tuple[str, ...], digest: str
) -> Trajectories | None:
    if file is None or not file.exists():
        return None
    saved_task, trajectories = load_trajectories(file)
    if saved_task != task or trajectories.list_methods() != methods:
        raise UserError(f"{file} holds walks with other settings: give another --out, or delete it")
    if str(trajectories.provenance) != digest:
        raise UserError(
            f"{file} holds walks of another model or sensor, or of an earlier simulator: "
            "give another --out, or delete it"
        )
    return trajectories
