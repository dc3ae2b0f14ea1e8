"""The simulator and a model's networks made ready for touch after touch: inputs in, pictures and numbers out.

>>> explorer = make_explorer(folder, experiment)
>>> explorer.warm()                                    # compiles, with a bar
>>> picture = explorer.picture(touch)                  # raises UserError where there is none
>>> picture.poses["unsheared"]["edge_mm"], picture.poses["true"]["edge_mm"]
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.apps.explore.touch import BATCH, Touch, list_warmup_touches, simulate_touch
from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import Experiment, require_simulated, uses_pins
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.targets import SIMULATED_FIELDS
from jaxunshear.data.chunks import render_images
from jaxunshear.data.preprocessing import SensorFrame
from jaxunshear.data.recordings import read_image
from jaxunshear.errors import UserError
from jaxunshear.inference.perceiver import (
    AS_RECORDED,
    UNSHEARED,
    Perceiver,
    Predictions,
    find_pin_frame,
    load_perceiver,
)
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.png import to_uint8
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.perception.rest_positions import compute_rest_lattice
from jaxunshear.perception.sensor_check import NO_MINIMUM, invert_image, judge_images
from jaxunshear.progress import Progress
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import make_edge_labeler
from jaxunshear.simulator.stimuli import STIMULI, Stimulus

SHEARED, TAP, TRUE = "sheared", "tap", "true"
NO_EDGE_MM = 100.0  # a surface's edge is said to be further away than this


class Picture(NamedTuple):
    """What there is to see of one touch, or of one recorded image."""

    images: dict[
        str, np.ndarray
    ]  # by SHEARED, UNSHEARED and TAP, as far as there is one: (S, S) uint8
    poses: dict[
        str, dict[str, float]
    ]  # by TRUE, SHEARED and UNSHEARED: by quantity, mm and deg; NaN where there is none
    pins: np.ndarray  # (2, P, 2) px: untouched, and at the slide's end; none of a recorded image
    state: np.ndarray  # (P,) of touch.FREE, STUCK, SLIPPING
    force_n: np.ndarray  # (3,) on the sensor
    note: str = ""  # one line: why something is missing


@dataclass(frozen=True)
class Explorer:
    experiment: Experiment
    paired: PairedData  # how frames of the simulated sensor are taken and prepared
    perceive: Perceiver  # of simulated frames
    recordings: Callable[
        [], Perceiver
    ]  # of recorded ones; raises UserError where these cannot be read
    own_stimuli: tuple[Stimulus, ...] = ()  # shapes beside those that have a name

    @property
    def stimuli(self) -> dict[str, Stimulus]:
        """To choose from; those of one's own come first."""
        return {stimulus.name: stimulus for stimulus in (*self.own_stimuli, *STIMULI.values())}

    def warm(self) -> None:
        """Compiles what a touch of the model's own sensor needs."""
        touches = list_warmup_touches(self.experiment.sensor, self.paired.friction or 0.0)
        with Progress("prepare", len(touches) + len(self.stimuli), "touches") as bar:
            for touch in touches:
                self.simulate_picture(touch)
                bar.advance()
            for stimulus in self.stimuli.values():
                self.simulate_picture(replace(touches[1], stimulus=stimulus))
                bar.advance()

    def simulate_picture(self, touch: Touch) -> Picture:
        """Raises UserError where the contact cannot be simulated."""
        felt = simulate_touch(touch)
        number, age = np.arange(BATCH), np.zeros(BATCH)
        seen, pins = render_images(self.paired, touch.sensor, felt.tips, number, age, at_once=BATCH)
        rest = _untouched_px(touch.sensor, self.paired)
        images, note = {SHEARED: seen[0], TAP: seen[1]}, ""
        poses = {TRUE: _true_pose(touch, self.perceive.targets)}
        if touch.sensor != self.experiment.sensor:
            note = judge_images(seen[:1], self.perceive.expected).reason
            note = f"the model does not know this sensor: {note or 'its pins only resemble those that it learnt from'}"
        else:
            # what the simulator draws is of this sensor, however far it is pressed
            note = _add_answer(
                images, poses, self.perceive._replace(min_plausibility=NO_MINIMUM).predict(seen[:1])
            )
        return Picture(images, poses, np.stack([rest, pins[0]]), felt.state, felt.force_n, note)

    def infer_recorded(self, name: str, data: bytes) -> Picture:
        """Of an image file's bytes. Raises UserError, as `unshear` does, for what is no image or not one of the model's sensor."""
        network = self.recordings()
        try:
            raw = read_image(data)
            image = prepare_frame(network.preprocess, raw, network.view or View())
        except UserError as error:
            raise UserError(f"{name}: {error}") from None
        found = judge_images(image[None], network.expected)
        if not found.ok and not found.inverted:
            raise UserError(f"{name}: {found.reason}")
        images: dict[str, np.ndarray] = {SHEARED: invert_image(image) if found.inverted else image}
        poses: dict[str, dict[str, float]] = {}
        note = _add_answer(
            images,
            poses,
            network._replace(min_plausibility=NO_MINIMUM).predict(images[SHEARED][None]),
        )
        return Picture(images, poses, np.zeros((2, 0, 2)), np.zeros(0, int), np.zeros(3), note)


def make_explorer(
    folder: Path, experiment: Experiment, like: Path | None = None, own: tuple[Stimulus, ...] = ()
) -> Explorer:
    """Of the networks in a folder. `like` shows where pins stand in recordings, for networks over pins. Raises UserError."""
    paired, _ = require_simulated(experiment, "explore")
    pins = uses_pins(experiment)
    perceive = load_perceiver(
        folder, experiment, True, _simulated_frame(experiment.sensor, paired) if pins else None
    )

    @lru_cache(maxsize=1)
    def recordings() -> Perceiver:
        return (
            load_perceiver(
                folder, experiment, True, find_pin_frame(like, experiment) if like else None
            )
            if pins
            else perceive
        )

    return Explorer(experiment, paired, perceive, recordings, own)


def _add_answer(
    images: dict[str, np.ndarray], poses: dict[str, dict[str, float]], answers: Predictions
) -> str:
    """Adds the networks' answer on one image to its pictures and numbers; what hinders it, in one line."""
    if answers.rejection[0]:
        return f"no unsheared image: {answers.rejection[0]}"
    if answers.unsheared is not None:
        images[UNSHEARED] = to_uint8(answers.unsheared[0])
    for way, key in ((AS_RECORDED, SHEARED), (UNSHEARED, UNSHEARED)):
        if way in answers.poses:
            poses[key] = {name: float(values[0]) for name, values in answers.poses[way].items()}
    return ""


def _true_pose(touch: Touch, names: tuple[str, ...]) -> dict[str, float]:
    """What a PoseNet's quantities are in truth; NaN for those of an edge where there is none."""
    distance, angle = _make_edge_labeler(touch.stimulus)(np.array([touch.pose[:3]]))[0]
    edge = (float(distance), float(angle)) if abs(distance) < NO_EDGE_MM else (np.nan, np.nan)
    known = {"pose": (*touch.pose, 0.0, 0.0), "edge": edge}
    return {
        name: known[field][column]
        for name, (field, column) in SIMULATED_FIELDS.items()
        if name in names
    }


@lru_cache(maxsize=32)
def _make_edge_labeler(stimulus: Stimulus) -> Callable[[np.ndarray], np.ndarray]:
    return make_edge_labeler(stimulus)


@lru_cache(maxsize=8)
def _untouched_px(sensor: Sensor, paired: PairedData) -> np.ndarray:
    return compute_rest_lattice(sensor, paired.camera, paired.preprocess).rest


def _simulated_frame(sensor: Sensor, paired: PairedData) -> SensorFrame:
    """What the simulator's frames have in common."""
    lattice = compute_rest_lattice(sensor, paired.camera, paired.preprocess)
    image = render_images(
        paired, sensor, compute_pin_tips(sensor)[None], np.zeros(1), np.zeros(1), at_once=1
    )[0][0]
    size = paired.preprocess.size
    return SensorFrame(
        View(), lattice.rest, lattice.ring, lattice.spacing, detect_pins(image).radius, size, size
    )
