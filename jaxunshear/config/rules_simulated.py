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
from jaxunshear.config.stimuli import SHOWN_TARGETS, list_stimulus_names
from jaxunshear.config.targets import (
    PAPER_TARGETS,
    SIMULATED_FIELDS,
    list_target_names,
    make_range_targets,
)
from jaxunshear.config.types import Rule, list_declared_rules
from jaxunshear.errors import UserError

# fields of an experiment that add further tests, and how the names of these tests begin
FURTHER_TEST_PREFIXES = {
    "other_jitters_mm": "depth_",
    "other_twists_deg": "twist_",
    "other_tilts_deg": "tilt_",
}


def list_simulated_rules(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Rule]:
    """Yield the rules of an experiment about simulated touches."""
    sets: tuple[tuple[str, PairedData | PoseData], ...] = (("paired", paired), ("pose", pose))
    for group, data in sets:
        configs = CONFIGS[get_set_name(data)]
        yield Rule(
            data.config in configs,
            f"{group}.config",
            f"is no stored configuration: use one of {', '.join(configs)}; "
            "changed fields get a name of their own",
        )
        yield from _list_reach_rules(data, f"{group}.", experiment.sensor)
    yield from _list_stimulus_target_rules(experiment, paired, pose)
    yield from list_network_rules(experiment, paired.preprocess, pose.preprocess)
    if takes_taps(experiment):
        yield from _list_camera_rules(paired, pose)
        yield from _list_seed_rules(experiment, paired, pose)
        yield from _list_range_rules(paired.ranges, pose.ranges)
        yield from _list_equal_target_rules(experiment, paired, pose)
    yield from _list_test_rules(experiment, paired, pose)
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
    """Yield the rules that the sensor reaches every pose, and that its camera sees the pins."""
    ranges, dome = data.ranges, sensor.dome_radius_mm
    yield Rule(
        ranges.lateral_mm <= dome,
        f"{group}ranges.lateral_mm",
        f"use 0 to {dome:g} (the dome's radius): beyond it the target is not touched",
    )
    yield Rule(
        ranges.move_mm <= dome,
        f"{group}ranges.move_mm",
        f"use 0 to {dome:g} (the dome's radius)",
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
        f"this depth cannot be reached: a dome of radius {dome:g} mm goes to {deepest:.1f} mm"
        f"{leaning}",
    )
    jitter = data.tap_depth_jitter_mm if isinstance(data, PairedData) else 0.0
    yield Rule(
        ranges.depth_max_mm + jitter <= deepest,
        f"{group}tap_depth_jitter_mm",
        f"with ranges.depth_max_mm ({ranges.depth_max_mm:g}) it cannot be reached: "
        f"together at most {deepest:.1f} mm",
    )
    yield Rule(
        data.camera.distance_mm > dome,
        f"{group}camera.distance_mm",
        f"must exceed the dome's radius ({dome:g}): the camera views the pins from above",
    )


def _list_test_rules(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    """Yield the rules of unseen stimuli and of further tests."""
    names = list_stimulus_names({*paired.stimuli, *pose.stimuli})
    repeated = ", ".join(sorted({name for name in names if names.count(name) > 1}))
    yield Rule(
        not repeated,
        "pose.stimuli",
        f"two outlines are called {repeated}: give each a name of its own",
    )
    trained = ", ".join(name for name in list_stimulus_names(experiment.unseen) if name in names)
    yield Rule(not trained, "unseen", f"{trained} is trained on: name it in one place only")
    for field, prefix in FURTHER_TEST_PREFIXES.items():
        values = [f"{value:g}" for value in getattr(experiment, field)]  # as tests are named
        yield Rule(len(set(values)) == len(values), field, "name each once")
        for name, data in list_further_tests(experiment).items():
            if name.startswith(prefix):
                yield from _list_further_test_rules(experiment, data, field)
    max_tilt = pose.ranges.tilt_deg
    reads_poses = not {POSENET, TEACHER}.isdisjoint(list_trained_networks(experiment))
    yield Rule(
        not reads_poses or max(experiment.other_tilts_deg, default=0) <= max_tilt,
        "other_tilts_deg",
        f"goes beyond pose.ranges.tilt_deg ({max_tilt:g}), where PoseNet knows no pose: "
        "widen that one, too",
    )


def _list_further_test_rules(
    experiment: Experiment, data: PairedData, field: str
) -> Iterator[Rule]:
    """Yield the rules of the set of a further test, as rules of the field that adds the test."""
    for rule in (*list_declared_rules(data), *_list_reach_rules(data, "", experiment.sensor)):
        yield rule._replace(field=field)
    yield _make_target_rule(experiment, data.ranges, field, "leaves nothing to predict")


def _list_stimulus_target_rules(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Rule]:
    """Yield the rules that targets exist, that the stimuli show them, and that they vary."""
    yield from list_target_rules(experiment.targets, SIMULATED_FIELDS)
    stimuli = {*paired.stimuli, *pose.stimuli, *experiment.unseen}
    targets = {text.partition(":")[0] for text in experiment.targets or PAPER_TARGETS}
    for stimulus, shown in SHOWN_TARGETS.items():
        hidden = sorted(targets - {*shown})
        yield Rule(
            stimulus not in stimuli or not hidden,
            "targets",
            f"the stimulus '{stimulus}' does not show {', '.join(hidden)}: "
            f"name of {', '.join(shown)}",
        )
    remedy = "there is none: the ranges of the poses leave nothing to predict"
    for ranges in (paired.ranges, pose.ranges):
        yield _make_target_rule(experiment, ranges, "targets", remedy)


def _make_target_rule(experiment: Experiment, ranges: Ranges, field: str, remedy: str) -> Rule:
    """Make the rule that these ranges vary what is to be predicted."""
    try:
        targets = make_range_targets(experiment.targets, ranges)
    except UserError as error:
        return Rule(False, field, str(error))
    return Rule(len(targets) > 0, field, remedy)


def _list_equal_target_rules(
    experiment: Experiment, paired: PairedData, pose: PoseData
) -> Iterator[Rule]:
    """Yield the rules that pairs and taps have equal targets.

    PoseNet, which learns from taps, is scored by the poses of pairs; the outputs of a teacher are
    compared one by one.
    """
    pairs = make_range_targets(experiment.targets, paired.ranges)
    taps = make_range_targets(experiment.targets, pose.ranges)
    pair_names, tap_names = list_target_names(pairs), list_target_names(taps)
    yield Rule(
        pair_names == tap_names,
        "targets",
        f"pairs vary {', '.join(pair_names)} and taps {', '.join(tap_names)}: "
        "name those that both vary",
    )
    has_teacher = TEACHER in list_trained_networks(experiment)
    for pair, tap in zip(pairs, taps, strict=False):
        yield Rule(
            not has_teacher or pair.is_circular == tap.is_circular,
            "targets",
            f"{pair.name} goes round a circle in taps alone, and a teacher reads both: "
            f"write {pair.name}:circle",
        )


def _list_seed_rules(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    """Yield the rules that no test pose is among PoseNet's taps: sets of one seed share poses."""
    for settings in (paired, *list_further_tests(experiment).values()):
        yield Rule(
            settings.seed != pose.seed or not set(settings.names) & set(pose.names),
            "pose.seed",
            "gives PoseNet the taps of poses that it is tested at: use another",
        )


def _list_range_rules(pairs: Ranges, taps: Ranges) -> Iterator[Rule]:
    """Yield the rules that PoseNet's taps cover the poses of the pairs."""
    for field in ("lateral_mm", "yaw_deg", "depth_max_mm", "tilt_deg"):
        limit = getattr(taps, field)
        yield Rule(
            getattr(pairs, field) <= limit,
            f"paired.ranges.{field}",
            f"goes beyond pose.ranges.{field} ({limit:g}), where PoseNet knows no pose: "
            "widen that one, too",
        )
    limit = taps.depth_min_mm
    yield Rule(
        pairs.depth_min_mm >= limit,
        "paired.ranges.depth_min_mm",
        f"is below pose.ranges.depth_min_mm ({limit:g}), where PoseNet knows no pose: "
        "lower that one, too",
    )


def _list_camera_rules(paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    """Yield the rules that pairs and taps have the same camera and preprocessing."""
    for group in ("camera", "preprocess"):
        pair_settings, tap_settings = getattr(paired, group), getattr(pose, group)
        for field in fields(pair_settings):
            value = getattr(pair_settings, field.name)
            name = f"{group}.{field.name}"
            yield Rule(
                getattr(tap_settings, field.name) == value,
                f"pose.{name}",
                f"differs from paired.{name} ({value:g}): make them equal; "
                "PoseNet also reads the images of pairs",
            )


def count_training_poses(data: PairedData | PoseData) -> int:
    """Count the training poses of a set over all its stimuli."""
    return sum(count_train_poses(data.seed, name, data.poses) for name in data.names)
