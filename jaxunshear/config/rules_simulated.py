"""Rules between the settings of an experiment about simulated touches."""

from collections.abc import Iterator
from dataclasses import asdict

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import (
    FURTHER_TESTS,
    Experiment,
    list_further_tests,
    uses_pins,
)
from jaxunshear.config.network_config import list_trained_networks, takes_taps
from jaxunshear.config.networks import POSENET, TEACHER
from jaxunshear.config.sensor import Sensor, compute_contact_angle, compute_max_contact_depth_mm
from jaxunshear.config.stimuli import SHOWN_TARGETS, list_stimulus_names
from jaxunshear.config.targets import (
    PAPER_TARGETS,
    SIMULATED_FIELDS,
    Targets,
    list_target_names,
    list_text_problems,
    make_range_targets,
)
from jaxunshear.config.types import Rule, list_declared_rules
from jaxunshear.errors import UserError

# targets that stay true when a simulated contact is turned about the sensor's axis
ROTATED_TARGETS = {"edge_mm", "edge_deg", "depth_mm"}


def list_simulated_rules(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Rule]:
    """Yield the rules of an experiment about simulated touches."""
    yield from _list_reach_rules(paired, "paired.", experiment.sensor)
    yield from _list_reach_rules(pose, "pose.", experiment.sensor)
    yield from _list_target_rules(experiment, paired, pose)
    if takes_taps(experiment):
        yield from _list_tap_rules(experiment, paired, pose)
    yield from _list_test_rules(experiment, paired, pose)


def _list_reach_rules(data: PairedData | PoseData, group: str, sensor: Sensor) -> Iterator[Rule]:
    """Yield the rules that the sensor reaches every pose, and that its camera sees the pins."""
    ranges, dome = data.ranges, sensor.dome_radius_mm
    for field in ("lateral_mm", "move_mm"):
        yield Rule(
            getattr(ranges, field) <= dome,
            f"{group}ranges.{field}",
            f"use 0 to {dome:g} (the dome's radius): beyond it the target is not touched",
        )
    edge = compute_contact_angle(sensor)
    yield Rule(
        ranges.tilt_deg < edge,
        f"{group}ranges.tilt_deg",
        f"use 0 to below {edge:.0f}, where the dome's contact ends",
    )
    deepest = compute_max_contact_depth_mm(sensor, ranges.tilt_deg)
    for field, jitter in (
        ("ranges.depth_max_mm", 0.0),
        ("tap_depth_jitter_mm", getattr(data, "tap_depth_jitter_mm", 0.0)),
    ):
        depth = ranges.depth_max_mm + jitter
        yield Rule(
            depth <= deepest,
            f"{group}{field}",
            f"a depth of {depth:g} mm cannot be reached: a dome of radius {dome:g} mm goes to "
            f"{deepest:.1f} mm at a tilt of {ranges.tilt_deg:g} deg",
        )
    yield Rule(
        data.camera.distance_mm > dome,
        f"{group}camera.distance_mm",
        f"must exceed the dome's radius ({dome:g}): the camera views the pins from above",
    )


def _list_test_rules(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    names = list_stimulus_names({*paired.stimuli, *pose.stimuli})
    repeated = ", ".join(sorted({name for name in names if names.count(name) > 1}))
    yield Rule(
        not repeated,
        "pose.stimuli",
        f"two outlines are called {repeated}: give each a name of its own",
    )
    trained = ", ".join(name for name in list_stimulus_names(experiment.unseen) if name in names)
    yield Rule(not trained, "unseen", f"{trained} is trained on: name it in one place only")
    tests = list_further_tests(experiment)
    for field, further in FURTHER_TESTS.items():
        values = [further.format(value) for value in getattr(experiment, field)]
        yield Rule(len(set(values)) == len(values), field, "name each once")
        for data in (tests[value] for value in values):
            for rule in list_declared_rules(data):
                yield rule._replace(field=field)
            for rule in _list_reach_rules(data, "", experiment.sensor):
                yield rule._replace(field=field)
    max_tilt = pose.ranges.tilt_deg
    reads_poses = not {POSENET, TEACHER}.isdisjoint(list_trained_networks(experiment))
    yield Rule(
        not reads_poses or max(experiment.other_tilts_deg, default=0) <= max_tilt,
        "other_tilts_deg",
        f"goes beyond pose.ranges.tilt_deg ({max_tilt:g}), where PoseNet knows no pose: "
        "widen that one, too",
    )


def _list_target_rules(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Rule]:
    """Yield the rules that targets exist, that the stimuli show them, and that they vary."""
    for problem in list_text_problems(experiment.targets, SIMULATED_FIELDS):
        yield Rule(False, "targets", problem)
    named = {text.partition(":")[0] for text in experiment.targets}
    stimuli = {*paired.stimuli, *pose.stimuli, *experiment.unseen}
    for stimulus, shown in SHOWN_TARGETS.items():
        hidden = sorted((named or {text.partition(":")[0] for text in PAPER_TARGETS}) - {*shown})
        yield Rule(
            stimulus not in stimuli or not hidden,
            "targets",
            f"the stimulus '{stimulus}' does not show {', '.join(hidden)}: "
            f"name of {', '.join(shown)}",
        )
    tests = list_further_tests(experiment).values()
    for ranges in (data.ranges for data in (paired, pose, *tests)):
        problem = "there is none: the ranges of the poses leave nothing to predict"
        try:
            found = bool(make_range_targets(experiment.targets, ranges))
        except UserError as error:
            found, problem = False, str(error)
        yield Rule(found, "targets", problem)
    is_turned = uses_pins(experiment) and experiment.pins.turned > 0
    yield Rule(
        not is_turned or bool(named and named <= ROTATED_TARGETS),
        "pins.turned",
        "turns touches about the sensor's axis, which leaves them these targets alone: "
        f"{', '.join(sorted(ROTATED_TARGETS))}",
    )


def _list_tap_rules(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    """Yield the rules that PoseNet's taps suit the pairs whose poses it predicts."""
    for group in ("camera", "preprocess"):
        for field, value in asdict(getattr(paired, group)).items():
            yield Rule(
                getattr(getattr(pose, group), field) == value,
                f"pose.{group}.{field}",
                f"differs from paired.{group}.{field} ({value:g}): make them equal; "
                "PoseNet also reads the images of pairs",
            )
    for settings in (paired, *list_further_tests(experiment).values()):
        yield Rule(
            settings.seed != pose.seed or not set(settings.names) & set(pose.names),
            "pose.seed",
            "gives PoseNet the taps of poses that it is tested at: use another",
        )
    pairs, taps = paired.ranges, pose.ranges
    for field in ("lateral_mm", "yaw_deg", "depth_max_mm", "tilt_deg", "depth_min_mm"):
        value, limit = getattr(pairs, field), getattr(taps, field)
        yield Rule(
            value >= limit if field == "depth_min_mm" else value <= limit,
            f"paired.ranges.{field}",
            f"goes beyond pose.ranges.{field} ({limit:g}), where PoseNet knows no pose: "
            "widen that one, too",
        )
    yield from _list_equal_target_rules(
        experiment,
        make_range_targets(experiment.targets, pairs),
        make_range_targets(experiment.targets, taps),
    )


def _list_equal_target_rules(
    experiment: Experiment, pairs: Targets, taps: Targets
) -> Iterator[Rule]:
    """Yield the rules that pairs and taps have equal targets.

    PoseNet, which learns from taps, is scored by the poses of pairs; the outputs of a teacher are
    compared one by one.
    """
    pair_names, tap_names = list_target_names(pairs), list_target_names(taps)
    yield Rule(
        pair_names == tap_names,
        "targets",
        f"pairs vary {', '.join(pair_names)} and taps {', '.join(tap_names)}: "
        "name those that both vary",
    )
    if TEACHER in list_trained_networks(experiment):
        for pair, tap in zip(pairs, taps, strict=True):
            yield Rule(
                pair.is_circular == tap.is_circular,
                "targets",
                f"{pair.name} goes round a circle in taps alone, and a teacher reads both: "
                f"write {pair.name}:circle",
            )
    yield Rule(
        "pose_label" not in experiment.train.losses or pairs == taps,
        "train.losses.pose_label",
        "asks for one scale of poses: make paired.ranges and pose.ranges equal, or use pose_tap",
    )
