"""Runs the simulator and a model's networks for one touch after another.

>>> pose, move = (0.0, 0.0, 0.0, 3.0), (2.0, 0.0)
>>> touch = Touch(get_stimulus("disk"), get_sensor("tactip331-fitted"), pose, move, 0.4)
>>> result = simulate_touch(touch)                     # raises UserError if there is no contact
>>> explorer = make_explorer(load_model("standard"))
>>> picture = explorer.simulate_picture(touch)         # raises UserError if there is none
>>> picture.poses["unsheared"]["edge_mm"], picture.poses["true"]["edge_mm"]
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.config.contact_rings import compute_ring_spacing
from jaxunshear.config.data import PairedData, Ranges
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.targets import SIMULATED_FIELDS
from jaxunshear.data.recordings import read_image
from jaxunshear.data.sensor_frame import SensorFrame
from jaxunshear.data.simulation import render_images
from jaxunshear.errors import UserError
from jaxunshear.inference.forward import AS_RECORDED, UNSHEARED
from jaxunshear.inference.readers import Predictions, make_touch_reader
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.metrics import count_scales, ms_ssim
from jaxunshear.perception.drawing import to_uint8
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.perception.sensor_check import invert_image, judge_images
from jaxunshear.perception.touch import find_no_contact
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.level import LEVELS, Level
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes, make_edge_labeler
from jaxunshear.simulator.scheduler import NODE_COUNTS, Simulation, make_plan, pad_count
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import STIMULI, Stimulus, get_stimulus

SHEARED, TAP, TRUE = "sheared", "tap", "true"
NO_EDGE_MM = 100.0  # a surface's edge is said to be further away than this
# `auto` with friction for taps, too: a tap and a slide then share a batch and compiled programs
LEVEL = replace(
    LEVELS["auto"], omit=tuple(name for name in LEVELS["auto"].omit if name != "friction")
)
BATCH = 2  # a slide and the tap at its end
DEEPEST_MM, MOST_SLIDE_MM = 6.0, 5.0  # of touches that are compiled beforehand
FREE, STUCK, SLIPPING = range(3)
ROUNDING = 1e-3  # of the greatest friction, within which a node slips
LIMIT_ROUNDING = 1e-6  # mm and deg
# the page begins with a slide on the disk's edge, whose shear `standard` removes well
FIRST_POSE, FIRST_MOVE = (0.0, 0.0, 0.0, 3.0), (2.0, 1.5)


@dataclass(frozen=True)
class Touch:
    """A sensor that is pressed down at `pose` - `move`, and then slides by `move`."""

    stimulus: Stimulus
    sensor: Sensor
    pose: tuple[float, ...]  # at the end: x, y (mm), yaw (deg), depth (mm) in the target frame
    move: tuple[float, float]  # mm, target frame
    friction: float  # Coulomb coefficient


class TouchResult(NamedTuple):
    """The contacts of a slide and of the tap at its end, in this order."""

    sensor: Sensor
    tips: np.ndarray  # (2, P, 3) mm, pin tips in the sensor frame
    state: np.ndarray  # (P,) FREE, STUCK or SLIPPING: the skin above each pin, at the slide's end
    force_n: np.ndarray  # (3,) N on the sensor at the slide's end
    skin_force_n: np.ndarray  # (N, 3) N on each contact node then


def make_scenes(touch: Touch) -> Scenes:
    """Make the scenes of a slide and of the tap at its end."""
    pose = np.array([touch.pose] * 2, float)
    move = np.array([touch.move, (0.0, 0.0)], float)
    return Scenes(np.zeros(2, int), pose, move, np.full(2, float(touch.friction)))


def simulate_touch(touch: Touch, level: Level = LEVEL) -> TouchResult:
    """Simulate a touch.

    Raises UserError if the contact model does not cover it, or a contact does not converge.
    """
    try:
        contacts, skins = follow(
            touch.sensor,
            (touch.stimulus,),
            make_paths(make_scenes(touch)),
            level,
            batch=BATCH,
            retry=False,
        )
    except UserError as error:
        raise UserError(str(error).removeprefix("scene 0: ")) from None
    if not contacts.converged.all():
        contact = "slide" if not contacts.converged[0] else "tap"
        raise UserError(
            f"the contact of this {contact} did not converge: "
            "move the sensor a little, or press less deep"
        )
    return TouchResult(
        touch.sensor,
        contacts.pins,
        compute_skin_state(touch.sensor, skins.force_n[0], touch.friction),
        contacts.force_n[0],
        skins.force_n[0],
    )


def compute_skin_state(sensor: Sensor, force_n: np.ndarray, friction: float) -> np.ndarray:
    """Compute FREE, STUCK or SLIPPING (P,) of the skin above each pin of an upright sensor.

    `force_n` (N, 3) has the forces on the contact nodes.
    """
    pressure, pull = force_n[:, 2], np.hypot(force_n[:, 0], force_n[:, 1])
    slips = pull >= (1 - ROUNDING) * friction * pressure
    state = np.where(pressure > 0, np.where(slips, SLIPPING, STUCK), FREE)
    nearest, near = _find_nodes_above(sensor)
    return np.where(near, state[nearest], FREE)


@lru_cache(maxsize=8)
def _find_nodes_above(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Find the contact node (P,) nearest to the skin above each pin, and whether it is near (P,).

    A near node is less than a ring away.
    """
    centre = np.array([0, 0, sensor.dome_radius_mm])

    def compute_directions(points: np.ndarray) -> np.ndarray:
        return (points - centre) / np.linalg.norm(points - centre, axis=-1, keepdims=True)

    nodes = cKDTree(compute_directions(load_shared_dome(sensor).nodes))
    distance, nearest = nodes.query(compute_directions(compute_pin_tips(sensor)))
    return nearest, distance * sensor.dome_radius_mm < compute_ring_spacing(sensor)


def list_warmup_touches(sensor: Sensor, friction: float) -> list[Touch]:
    """List a touch for every size of contact up to DEEPEST_MM, shallow ones first.

    Each size is a program to compile.
    """
    touches: dict[int, Touch] = {}  # by number of nodes
    moves = (0.0, 0.0), (1.0, 0.0), (0.0, 2.5), (0.0, MOST_SLIDE_MM)
    for number, depth in enumerate(np.linspace(0.3, DEEPEST_MM, 20)):
        for name, x in (("edge", 6.0), ("edge", 3.0), ("edge", 0.0), ("surface", 0.0)):
            pose = (x, 0.0, 0.0, float(depth))
            touch = Touch(get_stimulus(name), sensor, pose, moves[number % len(moves)], friction)
            simulation = Simulation(sensor, (touch.stimulus,), LEVEL, BATCH)
            batches = make_plan(simulation, make_paths(make_scenes(touch)))
            nodes = max(pad_count(len(batch.nodes), NODE_COUNTS) for batch in batches)
            touches.setdefault(nodes, touch)
    return list(touches.values())


class Picture(NamedTuple):
    """What is shown of one touch, or of one recorded image.

    Args:
        images: (S, S) uint8, by SHEARED, UNSHEARED and TAP, as far as there are any.
        poses: mm and deg, by TRUE, SHEARED and UNSHEARED and by quantity; NaN if there is none.
        note: one line that says why something is missing, or is not to be trusted.
        pins: (2, P, 2) px, untouched and at the slide's end.
        result: Of the contacts; None for a recorded image, as `pins`.
        likeness: MS-SSIM to the tap, by SHEARED and UNSHEARED.
        touch: contact, slip and shear by output; none where pins are not identified.
    """

    images: dict[str, np.ndarray]
    poses: dict[str, dict[str, float]]
    note: str = ""
    pins: np.ndarray | None = None
    result: TouchResult | None = None
    likeness: Mapping[str, float] = MappingProxyType({})
    touch: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Explorer:
    """A simulated sensor and the networks of a model."""

    paired: PairedData  # how frames of the simulated sensor are taken and prepared
    # what the simulator draws is of the model's sensor, however far it is pressed; recordings are
    # judged before they are given to the networks
    model: TrainedModel  # for simulated frames, whatever they show
    recording_model: TrainedModel  # for recorded frames, whatever they show
    own_stimuli: tuple[Stimulus, ...] = ()  # shapes beside those that have a name

    @property
    def stimuli(self) -> dict[str, Stimulus]:
        """The stimuli to choose from by name; those from files come first."""
        return {stimulus.name: stimulus for stimulus in (*self.own_stimuli, *STIMULI.values())}

    def list_touches(self) -> list[Touch]:
        """List the touches that compile what those of the model's own sensor need."""
        touches = list_warmup_touches(self.model.sensor, self.paired.friction or 0.0)
        shapes = self.stimuli.values()
        return touches + [replace(touches[1], stimulus=stimulus) for stimulus in shapes]

    def simulate_picture(self, touch: Touch) -> Picture:
        """Simulate a touch and run the networks. Raises UserError if there is no contact."""
        result = simulate_touch(touch)
        number, age = np.arange(BATCH), np.zeros(BATCH)
        frames, pins = render_images(
            self.paired, touch.sensor, result.tips, number, age, at_once=BATCH
        )
        images = {SHEARED: frames[0], TAP: frames[1]}
        poses = {TRUE: _compute_true_pose(touch, self.model.targets)}
        measured: Mapping[str, float] = {}
        if touch.sensor != self.model.sensor:
            reason = judge_images(frames[:1], self.model.appearance).reason
            reason = reason or "its pins only resemble those that it learnt from"
            note = f"the model does not know this sensor: {reason}"
        else:
            predictions = self.model.predict(frames[:1])
            measured = predictions.touch.describe(0)
            note = _add_predictions(images, poses, predictions)
            note = note or describe_limits(touch, self.paired.ranges)
        both = np.stack([_compute_rest_px(touch.sensor, self.paired), pins[0]])
        return Picture(images, poses, note, both, result, compute_likeness(images), measured)

    def infer_recording(self, name: str, data: bytes) -> Picture:
        """Run the networks on the bytes of an image file.

        Raises UserError, as `unshear` does, if it is no image or not of the model's sensor.
        """
        model = self.recording_model
        preprocess = model.preprocess
        try:
            raw = read_image(data)
            image = prepare_frame(preprocess, raw, model.view or View())
        except UserError as error:
            raise UserError(f"{name}: {error}") from None
        check = judge_images(image[None], model.appearance)
        if not check.ok and not check.inverted:
            raise UserError(f"{name}: {check.reason}")
        images: dict[str, np.ndarray] = {SHEARED: invert_image(image) if check.inverted else image}
        poses: dict[str, dict[str, float]] = {}
        predictions = model.predict(images[SHEARED][None])
        note = _add_predictions(images, poses, predictions)
        return Picture(images, poses, note, touch=predictions.touch.describe(0))


def make_explorer(model: TrainedModel, own_stimuli: tuple[Stimulus, ...] = ()) -> Explorer:
    """Make an explorer of a model. Raises UserError.

    For networks over pins, its frame shows where pins rest in recordings.
    """
    paired = model.require_simulation("explore")
    if model.sensor.is_flat:
        raise UserError(
            f"explore draws domes, and {model.sensor.name} is a pad: name a model of a dome"
        )
    model = simulated = replace(model, force=True)
    if model.reads_pins:
        simulated = replace(model, frame=_make_simulated_frame(model.sensor, paired))
        simulated.touch_reader = make_touch_reader(model.lattice, model.sensor)
    return Explorer(paired, simulated, model, own_stimuli)


def _add_predictions(
    images: dict[str, np.ndarray], poses: dict[str, dict[str, float]], predictions: Predictions
) -> str:
    """Add the predictions for one image; return in one line why there are none, or nothing."""
    if find_no_contact(predictions.touch)[0]:
        return "no touch: the pins stand as on an untouched dome"
    if predictions.rejection[0]:
        return f"no unsheared image: {predictions.rejection[0]}"
    if predictions.unsheared is not None:
        images[UNSHEARED] = to_uint8(predictions.unsheared[0])
    for method, key in ((AS_RECORDED, SHEARED), (UNSHEARED, UNSHEARED)):
        if method in predictions.poses:
            pose = predictions.poses[method]
            poses[key] = {name: float(values[0]) for name, values in pose.items()}
    return ""


def compute_likeness(images: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Compute MS-SSIM to the tap of the other images."""
    scaled = {name: image[None, ..., None] / np.float32(255) for name, image in images.items()}
    tap = scaled.pop(TAP)
    scales = count_scales(tap.shape[1])
    return {name: float(ms_ssim(image, tap, scales)[0]) for name, image in scaled.items()}


def describe_limits(touch: Touch, ranges: Ranges) -> str:
    """Say what of a touch the networks have not seen in training; nothing if they have seen all."""
    x, y, yaw, depth = touch.pose
    slide, side = max(map(abs, touch.move)), ranges.lateral_mm
    limits = {  # value, and the range that poses of the training are drawn from
        "depth": (depth, ranges.depth_min_mm, ranges.depth_max_mm, "mm"),
        "x": (x, -side, side, "mm"),
        "y": (y, -side, side, "mm"),
        "slide along x or y": (slide, 0.0, ranges.move_mm, "mm"),
        "yaw": (yaw, -ranges.yaw_deg, ranges.yaw_deg, "deg"),
    }
    parts = [
        f"{name} {value:.3g} {unit} (learnt: {low:g} to {high:g})"
        for name, (value, low, high, unit) in limits.items()
        if not low - LIMIT_ROUNDING <= value <= high + LIMIT_ROUNDING
    ]
    return f"outside what the networks know: {', '.join(parts)}" if parts else ""


def _compute_true_pose(touch: Touch, names: tuple[str, ...]) -> dict[str, float]:
    """Compute the true values of PoseNet's quantities; NaN for an edge that is not there."""
    distance, angle = _make_edge_labeler(touch.stimulus)(np.array([touch.pose[:3]]))[0]
    edge = (float(distance), float(angle)) if abs(distance) < NO_EDGE_MM else (np.nan, np.nan)
    labels = {"pose": (*touch.pose, 0.0, 0.0), "edge": edge}
    return {
        name: labels[field][column]
        for name, (field, column) in SIMULATED_FIELDS.items()
        if name in names
    }


_make_edge_labeler = lru_cache(maxsize=32)(make_edge_labeler)


@lru_cache(maxsize=8)
def _compute_rest_px(sensor: Sensor, paired: PairedData) -> np.ndarray:
    return compute_rest_lattice(sensor, paired.camera, paired.preprocess).rest


def _make_simulated_frame(sensor: Sensor, paired: PairedData) -> SensorFrame:
    lattice = compute_rest_lattice(sensor, paired.camera, paired.preprocess)
    tips = compute_pin_tips(sensor)[None]
    images, _ = render_images(paired, sensor, tips, np.zeros(1), np.zeros(1), at_once=1)
    radius = detect_pins(images[0]).radius
    size = paired.preprocess.size
    return SensorFrame(View(), lattice.rest, lattice.ring, lattice.spacing, radius, size, size)
