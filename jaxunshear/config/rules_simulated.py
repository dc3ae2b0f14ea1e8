"""Problems between the settings of an experiment about simulated touches."""

from collections.abc import Iterator
from dataclasses import asdict
from itertools import chain

from jaxunshear.config.contact_rings import compute_contact_angle, compute_max_contact_depth_mm
from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import (
    FURTHER_TESTS,
    Experiment,
    list_further_tests,
    uses_pins,
)
from jaxunshear.config.network_config import list_trained_networks, takes_taps
from jaxunshear.config.networks import POSENET, TEACHER
from jaxunshear.config.sensor import MarkerSensor, Sensor
from jaxunshear.config.stimuli import SHOWN_TARGETS, list_stimulus_names
from jaxunshear.config.targets import (
    PAPER_TARGETS,
    SIMULATED_FIELDS,
    list_target_names,
    list_text_problems,
    make_range_targets,
)
from jaxunshear.config.types import Problem, find_problems
from jaxunshear.errors import UserError

UNKNOWN_POSE = "goes beyond pose.ranges.{} ({:g}), where PoseNet knows no pose: widen that one, too"
# targets that stay true when a simulated contact is turned about the sensor's axis
ROTATED_TARGETS = {"edge_mm", "edge_deg", "depth_mm"}


def find_simulated_problems(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Problem]:
    if isinstance(experiment.sensor, MarkerSensor):
        remedy = "simulate one that `jaxunshear sensors` lists"
        yield "sensor", f"is known by a layout file, which has no millimetres: {remedy}"
    yield from _find_reach_problems(paired, "paired.", experiment.sensor)
    yield from _find_reach_problems(pose, "pose.", experiment.sensor)
    yield from _find_target_problems(experiment, paired, pose)
    if takes_taps(experiment):
        yield from _find_tap_problems(experiment, paired, pose)
        yield from _find_scale_problems(experiment, paired, pose)
    yield from _find_test_problems(experiment, paired, pose)


def _find_reach_problems(
    data: PairedData | PoseData, group: str, sensor: Sensor
) -> Iterator[Problem]:
    """Find poses that the sensor does not reach, and a camera that does not see the pins."""
    ranges, rim, kind = data.ranges, sensor.radius_mm, "pad" if sensor.is_flat else "dome"
    for field in ("lateral_mm", "move_mm"):
        if getattr(ranges, field) > rim:
            remedy = f"use 0 to {rim:g} (the {kind}'s radius): beyond it the target is not touched"
            yield f"{group}ranges.{field}", remedy
    edge = compute_contact_angle(sensor)
    if ranges.tilt_deg >= edge:
        limit = f"{edge:.1f}" if sensor.is_flat else f"{edge:.0f}"
        remedy = f"use 0 to below {limit}, where the {kind}'s contact ends"
        yield f"{group}ranges.tilt_deg", remedy
    deepest = compute_max_contact_depth_mm(sensor, ranges.tilt_deg)
    for field, jitter in (
        ("ranges.depth_max_mm", 0.0),
        ("tap_depth_jitter_mm", getattr(data, "tap_depth_jitter_mm", 0.0)),
    ):
        depth = ranges.depth_max_mm + jitter
        if depth > deepest:
            size = f"{sensor.height_mm:g} mm thick" if sensor.is_flat else f"of radius {rim:g} mm"
            remedy = f"to {deepest:.2g} mm at a tilt of {ranges.tilt_deg:g} deg"
            problem = f"a depth of {depth:g} mm cannot be reached: a {kind} {size} goes"
            yield f"{group}{field}", f"{problem} {remedy}"
    if data.camera.distance_mm <= sensor.height_mm:
        size = f"thickness ({sensor.height_mm:g})" if sensor.is_flat else f"radius ({rim:g})"
        remedy = f"must exceed the {kind}'s {size}: the camera views the pins from above"
        yield f"{group}camera.distance_mm", remedy


def _find_target_problems(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Problem]:
    """Find targets that are unknown, that the stimuli do not show, or that do not vary."""
    for problem in list_text_problems(experiment.targets, SIMULATED_FIELDS):
        yield "targets", problem
    named = {text.partition(":")[0] for text in experiment.targets}
    predicted = named or {text.partition(":")[0] for text in PAPER_TARGETS}
    stimuli = {*paired.stimuli, *pose.stimuli, *experiment.unseen}
    for stimulus, shown in SHOWN_TARGETS.items():
        hidden = ", ".join(sorted(predicted - {*shown}))
        if stimulus in stimuli and hidden:
            remedy = f"does not show {hidden}: name of {', '.join(shown)}"
            yield "targets", f"the stimulus '{stimulus}' {remedy}"
    for data in (paired, pose, *list_further_tests(experiment).values()):
        try:
            if not make_range_targets(experiment.targets, data.ranges):
                yield "targets", "there is none: the ranges of the poses leave nothing to predict"
        except UserError as error:
            yield "targets", str(error)
    turns_pins = uses_pins(experiment) and experiment.pins.rotated_share > 0
    if turns_pins and not (named and named <= ROTATED_TARGETS):
        remedy = f"which leaves them these targets alone: {', '.join(sorted(ROTATED_TARGETS))}"
        yield "pins.rotated_share", f"turns touches about the sensor's axis, {remedy}"


def _find_tap_problems(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Problem]:
    """Find what PoseNet's taps lack for predicting the poses of pairs."""
    for group in ("camera", "preprocess"):
        for field, value in asdict(getattr(paired, group)).items():
            if getattr(getattr(pose, group), field) != value:
                remedy = "make them equal; PoseNet also reads the images of pairs"
                problem = f"differs from paired.{group}.{field} ({value:g}): {remedy}"
                yield f"pose.{group}.{field}", problem
    for settings in (paired, *list_further_tests(experiment).values()):
        if settings.seed == pose.seed and set(settings.names) & set(pose.names):
            yield "pose.seed", "gives PoseNet the taps of poses that it is tested at: use another"
    for field in ("lateral_mm", "yaw_deg", "depth_max_mm", "tilt_deg", "depth_min_mm"):
        value, limit = getattr(paired.ranges, field), getattr(pose.ranges, field)
        if value < limit if field == "depth_min_mm" else value > limit:
            yield f"paired.ranges.{field}", UNKNOWN_POSE.format(field, limit)


def _find_scale_problems(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Problem]:
    """Find targets that differ between pairs and taps.

    PoseNet, which learns from taps, is scored by the poses of pairs; the outputs of a teacher are
    compared one by one.
    """
    pairs = make_range_targets(experiment.targets, paired.ranges)
    taps = make_range_targets(experiment.targets, pose.ranges)
    pair_names, tap_names = list_target_names(pairs), list_target_names(taps)
    if pair_names != tap_names:
        varied = f"pairs vary {', '.join(pair_names)} and taps {', '.join(tap_names)}"
        yield "targets", f"{varied}: name those that both vary"
    if TEACHER in list_trained_networks(experiment):
        for pair, tap in zip(pairs, taps, strict=True):
            if pair.is_circular != tap.is_circular:
                problem = f"{pair.name} goes round a circle in taps alone, and a teacher reads both"
                yield "targets", f"{problem}: write {pair.name}:circle"
    if "pose_label" in experiment.train.losses and pairs != taps:
        remedy = "make paired.ranges and pose.ranges equal, or use pose_tap"
        yield "train.losses.pose_label", f"asks for one scale of poses: {remedy}"


def _find_test_problems(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Problem]:
    names = list_stimulus_names({*paired.stimuli, *pose.stimuli})
    if repeated := ", ".join(sorted({name for name in names if names.count(name) > 1})):
        remedy = "give each a name of its own"
        yield "pose.stimuli", f"two outlines are called {repeated}: {remedy}"
    unseen = list_stimulus_names(experiment.unseen)
    if trained := ", ".join(name for name in unseen if name in names):
        yield "unseen", f"{trained} is trained on: name it in one place only"
    tests = list_further_tests(experiment)
    for field, (further, _) in FURTHER_TESTS.items():
        values = [further.format(value) for value in getattr(experiment, field)]
        if len(set(values)) < len(values):
            yield field, "name each once"
        for data in (tests[value] for value in values):
            reach = _find_reach_problems(data, "", experiment.sensor)
            for _, remedy in chain(find_problems(data), reach):
                yield field, remedy
    max_tilt = pose.ranges.tilt_deg
    reads_poses = not {POSENET, TEACHER}.isdisjoint(list_trained_networks(experiment))
    if reads_poses and max(experiment.other_tilts_deg, default=0) > max_tilt:
        yield "other_tilts_deg", UNKNOWN_POSE.format("tilt_deg", max_tilt)
