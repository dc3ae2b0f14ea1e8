"""Rules between the settings of an experiment about simulated touches."""

from collections.abc import Iterator
from dataclasses import fields

from jaxunshear.config.configs import CONFIGS, get_set_name
from jaxunshear.config.data import PairedData, PoseData, Ranges
from jaxunshear.config.experiment import (
    Experiment,
    list_further_tests,
    list_trained_networks,
    takes_taps,
)
from jaxunshear.config.reach import compute_contact_angle, compute_max_contact_depth_mm
from jaxunshear.config.registry import POSENET, TEACHER
from jaxunshear.config.rules_networks import (
    list_network_rules,
    list_target_rules,
    list_training_rules,
)
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.splits import count_train_poses
from jaxunshear.config.stimuli import STIMULUS_TEXTS, list_stimulus_names
from jaxunshear.config.targets import (
    PAPER_TARGETS,
    SIMULATED_FIELDS,
    list_target_names,
    make_range_targets,
)
from jaxunshear.config.types import Rule, list_declared_rules
from jaxunshear.errors import UserError

# fields of an experiment that ask for tests of their own, and how the names of these begin
FURTHER_TEST_PREFIXES = {
    "other_jitters_mm": "depth_",
    "other_twists_deg": "twist_",
    "other_tilts_deg": "tilt_",
}


def list_simulated_rules(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Rule]:
    for group, data in (("paired", paired), ("pose", pose)):
        known = CONFIGS[get_set_name(data)]
        yield Rule(
            data.config in known,
            f"{group}.config",
            f"is no stored configuration: use one of {', '.join(known)}; changed fields get a name of their own",
        )
        yield from _list_reach_rules(data, f"{group}.", experiment.sensor)
    yield from _targets(experiment, paired, pose)
    yield from list_network_rules(experiment, paired.preprocess, pose.preprocess)
    if takes_taps(experiment):
        yield from _list_camera_rules(paired, pose)
        yield from _list_seed_rules(experiment, paired, pose)
        yield from _list_range_rules(paired.ranges, pose.ranges)
        yield from _same_targets(experiment, paired, pose)
    yield from _tests(experiment, paired, pose)
    pairs, taps = count_training_poses(paired) * paired.slides, count_training_poses(pose)
    yield from list_training_rules(experiment, pairs, taps)
    yield Rule(
        "pose_label" not in experiment.train.losses
        or make_range_targets(experiment.targets, paired.ranges)
        == make_range_targets(experiment.targets, pose.ranges),
        "train.losses.pose_label",
        "asks for one scale of poses: make paired.ranges and pose.ranges equal, or use pose_tap",
    )


def _list_reach_rules(data: PairedData | PoseData, group: str, sensor: Sensor) -> Iterator[Rule]:
    """What the sensor can reach, and its camera see."""
    ranges, dome = data.ranges, sensor.dome_radius_mm
    yield Rule(
        ranges.lateral_mm <= dome,
        f"{group}ranges.lateral_mm",
        f"use 0 to {dome:g} (the dome's radius): beyond it the target is not touched",
    )
    yield Rule(
        ranges.move_mm <= dome, f"{group}ranges.move_mm", f"use 0 to {dome:g} (the dome's radius)"
    )
    edge = compute_contact_angle(sensor)
    yield Rule(
        ranges.tilt_deg < edge,
        f"{group}ranges.tilt_deg",
        f"use 0 to below {edge:.0f}, where the dome's contact ends",
    )
    deepest = compute_max_contact_depth_mm(sensor, ranges.tilt_deg)
    leaning = (
        f" at a tilt of {ranges.tilt_deg:g} deg: use less of either" if ranges.tilt_deg else ""
    )
    yield Rule(
        ranges.depth_max_mm <= deepest,
        f"{group}ranges.depth_max_mm",
        f"this depth cannot be reached: a dome of radius {dome:g} mm goes to {deepest:.1f} mm{leaning}",
    )
    jitter = data.tap_depth_jitter_mm if isinstance(data, PairedData) else 0.0
    yield Rule(
        ranges.depth_max_mm + jitter <= deepest,
        f"{group}tap_depth_jitter_mm",
        f"with ranges.depth_max_mm ({ranges.depth_max_mm:g}) it cannot be reached: together at most {deepest:.1f} mm",
    )
    yield Rule(
        data.camera.distance_mm > dome,
        f"{group}camera.distance_mm",
        f"must exceed the dome's radius ({dome:g}): the camera views the pins from above",
    )


def _tests(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    outlines = {*paired.stimuli, *pose.stimuli}
    twice = ", ".join(
        sorted(
            {
                name
                for name in list_stimulus_names(outlines)
                if list_stimulus_names(outlines).count(name) > 1
            }
        )
    )
    yield Rule(
        not twice, "pose.stimuli", f"two outlines are called {twice}: give each a name of its own"
    )
    seen = ", ".join(
        name
        for name in list_stimulus_names(experiment.unseen)
        if name in {*paired.names, *pose.names}
    )
    yield Rule(not seen, "unseen", f"{seen} is trained on: name it in one place only")
    for field in FURTHER_TEST_PREFIXES:
        names = [f"{value:g}" for value in getattr(experiment, field)]  # they name their tests
        yield Rule(len(set(names)) == len(names), field, "name each once")
        for data in (
            data
            for name, data in list_further_tests(experiment).items()
            if name.startswith(FURTHER_TEST_PREFIXES[field])
        ):
            for holds, _, remedy in (
                *list_declared_rules(data),
                *_list_reach_rules(data, "", experiment.sensor),
            ):
                yield Rule(holds, field, remedy)
            yield from _list_target_rules(
                experiment, data.ranges, field, "leaves nothing to predict"
            )
    most = pose.ranges.tilt_deg
    remedy = f"goes beyond pose.ranges.tilt_deg ({most:g}), where PoseNet knows no pose: widen that one, too"
    read = bool({POSENET, TEACHER} & set(list_trained_networks(experiment)))
    yield Rule(
        not read or max(experiment.other_tilts_deg, default=0) <= most, "other_tilts_deg", remedy
    )


def _targets(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    yield from list_target_rules(experiment.targets, SIMULATED_FIELDS)
    touched = {*paired.stimuli, *pose.stimuli, *experiment.unseen}
    named = {text.partition(":")[0] for text in experiment.targets or PAPER_TARGETS}
    for stimulus, shown in STIMULUS_TEXTS.items():
        hidden = sorted(named - {*shown})
        remedy = f"the stimulus '{stimulus}' does not show {', '.join(hidden)}: name of {', '.join(shown)}"
        yield Rule(stimulus not in touched or not hidden, "targets", remedy)
    for ranges in (paired.ranges, pose.ranges):
        yield from _list_target_rules(
            experiment,
            ranges,
            "targets",
            "there is none: the ranges of the poses leave nothing to predict",
        )


def _list_target_rules(
    experiment: Experiment, ranges: Ranges, field: str, none: str
) -> Iterator[Rule]:
    """Whether these ranges vary what is to be predicted."""
    try:
        varied, wrong = len(make_range_targets(experiment.targets, ranges)) > 0, none
    except UserError as error:
        varied, wrong = False, str(error)
    yield Rule(varied, field, wrong)


def _same_targets(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    """PoseNet, which learns from taps, is judged by the poses of pairs; a teacher's outputs are compared one by one."""
    pairs, taps = (make_range_targets(experiment.targets, part.ranges) for part in (paired, pose))
    remedy = f"pairs vary {', '.join(list_target_names(pairs))} and taps {', '.join(list_target_names(taps))}: name those that both vary"
    yield Rule(list_target_names(pairs) == list_target_names(taps), "targets", remedy)
    for pair, tap in zip(pairs, taps, strict=False):
        remedy = f"{pair.name} goes round a circle in taps alone, and a teacher reads both: write {pair.name}:circle"
        yield Rule(
            TEACHER not in list_trained_networks(experiment) or pair.is_circular == tap.is_circular,
            "targets",
            remedy,
        )


def _list_seed_rules(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    """Sets of one seed hold the same poses: a test's would be among PoseNet's taps."""
    for settings in (paired, *list_further_tests(experiment).values()):
        yield Rule(
            settings.seed != pose.seed or not set(settings.names) & set(pose.names),
            "pose.seed",
            "gives PoseNet the taps of poses that it is tested at: use another",
        )


def _list_range_rules(pairs: Ranges, taps: Ranges) -> Iterator[Rule]:
    for field in ("lateral_mm", "yaw_deg", "depth_max_mm", "tilt_deg"):
        most = getattr(taps, field)
        remedy = f"goes beyond pose.ranges.{field} ({most:g}), where PoseNet knows no pose: widen that one, too"
        yield Rule(getattr(pairs, field) <= most, f"paired.ranges.{field}", remedy)
    least = taps.depth_min_mm
    remedy = f"is below pose.ranges.depth_min_mm ({least:g}), where PoseNet knows no pose: lower that one, too"
    yield Rule(pairs.depth_min_mm >= least, "paired.ranges.depth_min_mm", remedy)


def _list_camera_rules(paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    for group in ("camera", "preprocess"):
        of_pairs, of_taps = getattr(paired, group), getattr(pose, group)
        for field in fields(of_pairs):
            value, name = getattr(of_pairs, field.name), f"{group}.{field.name}"
            yield Rule(
                getattr(of_taps, field.name) == value,
                f"pose.{name}",
                f"differs from paired.{name} ({value:g}): make them equal; PoseNet also reads the images of pairs",
            )


def count_training_poses(data: PairedData | PoseData) -> int:
    """Of all stimuli."""
    return sum(count_train_poses(data.seed, name, data.poses) for name in data.names)
