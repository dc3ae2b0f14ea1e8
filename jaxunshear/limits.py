"""What an experiment can and cannot ask for: a table of rules. Imports no JAX, so a refusal takes no time.

A rule is (holds, dotted field name, what is wrong and what to do instead). Later rules may rely on earlier ones.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields

from jaxunshear.contact.rings import contact_angle, deepest_touch_mm
from jaxunshear.dataset.configs import CONFIGS, set_name
from jaxunshear.dataset.settings import PAIRINGS, UNLABELLED, PairedData, PoseData, Ranges, Recorded, RecordedTaps
from jaxunshear.dataset.splits import BLOCK, train_poses
from jaxunshear.errors import UserError
from jaxunshear.experiment import (
    ALL_NETWORKS,
    PAIR_LOSSES,
    PIN_NETWORKS,
    RENDERER,
    TEACHER,
    Experiment,
    further_tests,
    over_pins,
    recorded_of,
    takes_taps,
    trained,
)
from jaxunshear.image.settings import Camera, Nuisance, Preprocess
from jaxunshear.scene.sensor import TACTIP_331_FITTED, Sensor, sensor_rules
from jaxunshear.targets import RECORDED, SIMULATED, SLIDES, names_of, of_ranges, parsed, slides_of
from jaxunshear.training.settings import Training

Rule = tuple[bool, str, str]

# The keys of `scene.stimuli.STIMULI`, which imports JAX; a test holds the two together.
STIMULUS_NAMES = ("disk", "clover", "teardrop", "flower", "leaf", "spiral_1", "spiral_2", "edge", "surface")
TURNED = {"edge_mm", "edge_deg", "depth_mm"}  # targets that a turned simulated touch has
SURFACE = "surface"  # the same wherever and however it is turned
OF_SURFACE = {"depth_mm", "tilt_x_deg", "tilt_y_deg"}  # targets that it shows
FURTHER = {
    "other_jitters_mm": "depth_",
    "other_twists_deg": "twist_",
    "other_tilts_deg": "tilt_",
}  # and how their tests' names begin
MOST_TWIST_DEG = 90.0
SCHEDULES = ("cosine", "steps")
OPTIMISERS = ("adam", "muon")
KERNELS = ("sum", "mean")
POSE_TARGETS = ("tap", "label")
PRECISIONS = ("float32", "bfloat16")
INPUTS = ("images", "pins")
SMALLEST_PX = 16
LARGEST_PX = 4096


def limits(experiment: Experiment) -> Iterator[Rule]:
    """All rules for `experiment`; the first that does not hold is the one to report."""
    yield _name(experiment.name), "name", "use letters, digits, '-', '_' and '.'; it names the folder of the results"
    yield _seed(experiment.seed), "seed", "use an integer from 0 to 2147483647"
    yield from _sensor(experiment.sensor)
    if isinstance(experiment.paired, PairedData) and isinstance(experiment.pose, PoseData):
        yield from _simulated(experiment, experiment.paired, experiment.pose)
    else:
        yield from _recorded(experiment)


def _simulated(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    yield from _paired(paired, experiment.sensor)
    yield from _pose(pose, experiment.sensor)
    yield from _targets(experiment, paired, pose)
    yield from _networks(experiment, paired.preprocess, pose.preprocess)
    if takes_taps(experiment):
        yield from _seen_alike(paired, pose)
        yield from _kept_out(experiment, paired, pose)
        yield from _covered(paired.ranges, pose.ranges)
        yield from _same_targets(experiment, paired, pose)
    yield from _tests(experiment, paired, pose)
    pairs, taps = _train_poses(paired) * paired.slides, _train_poses(pose)
    yield from _trainings(experiment, pairs, taps)
    yield (
        experiment.train.pose_target != "label"
        or of_ranges(experiment.targets, paired.ranges) == of_ranges(experiment.targets, pose.ranges),
        "train.pose_target",
        "asks for one scale of poses: make paired.ranges and pose.ranges equal, or use tap",
    )


def _recorded(experiment: Experiment) -> Iterator[Rule]:
    """Of an experiment about recordings; what only they can show is refused when they are read."""
    recorded = experiment.paired
    if not isinstance(recorded, Recorded) or not isinstance(experiment.pose, RecordedTaps):
        yield (
            False,
            "name",
            "paired and pose are both simulated (PairedData, PoseData) or both recorded (Recorded, RecordedTaps)",
        )
        return
    yield (
        bool(recorded.tap_folder or recorded.slide_folder),
        "paired.tap_folder",
        "name your recordings: add --recordings DIR",
    )
    yield recorded.pairing in PAIRINGS, "paired.pairing", f"is unknown: use one of {', '.join(PAIRINGS)}"
    yield (
        bool(recorded.pairs) == (recorded.pairing == "file"),
        "paired.pairs",
        "a table of pairs goes with pairing file: add both, or neither",
    )
    yield (
        recorded.pairing != "simulated" or (recorded.labelled == 1 and recorded.unlabelled == "left_out"),
        "paired.pairing",
        "simulated takes no recorded slide to learn from: leave paired.labelled at 1 and paired.unlabelled at left_out",
    )
    yield (
        recorded.pairing != "simulated" or experiment.sensor.pins == TACTIP_331_FITTED.pins,
        "paired.pairing",
        f"simulated follows the one sensor that is fitted, of {TACTIP_331_FITTED.pins} pins; yours has {experiment.sensor.pins}",
    )
    yield 0 < recorded.labelled <= 1, "paired.labelled", "use a share above 0, at most 1"
    yield recorded.unlabelled in UNLABELLED, "paired.unlabelled", f"is unknown: use {' or '.join(UNLABELLED)}"
    yield (
        recorded.unlabelled == "left_out" or recorded.pairing in ("rendered", "nearest"),
        "paired.unlabelled",
        f"poses that are read give no partner for pairing {recorded.pairing}: use pairing rendered or nearest",
    )
    for field in ("test", "validation"):
        yield 0 < getattr(recorded, field) < 0.5, f"paired.{field}", "use a share between 0 and 0.5"
    yield _seed(recorded.seed), "paired.seed", "use an integer from 0 to 2147483647"
    yield from _preprocess(recorded.preprocess, "paired.preprocess")
    yield from _target_texts(experiment.targets, RECORDED | SLIDES)
    slides = slides_of(experiment.targets)
    yield (
        not slides or set(trained(experiment)) == {"posenet_sheared"},
        "targets",
        f"a tap has no {', '.join(slides)}: name --networks posenet_sheared alone",
    )
    yield not slides or not experiment.pins.turned, "pins.turned", f"does not turn {', '.join(slides)}: leave it at 0"
    yield from _networks(experiment, recorded.preprocess, recorded.preprocess)
    yield from _known_networks(experiment)
    for field in ("unseen", *FURTHER):
        yield not getattr(experiment, field), field, "is a test of simulated touches: leave it empty"
    yield from _trainings(experiment, LARGEST_PX**2, LARGEST_PX**2)


def _trainings(experiment: Experiment, pairs: int, taps: int) -> Iterator[Rule]:
    """Of `pairs` and `taps` to learn from."""
    yield from _training(experiment.train, "train", pairs)
    yield from _pair_losses(experiment.train, experiment.unshear.size)
    yield (
        not experiment.train.label_weight or "unet" not in experiment.networks,
        "train.label_weight",
        "asks for a code to read the pose off, and the network unet has none: leave one of the two out",
    )
    yield (
        not experiment.train_teacher.start,
        "train_teacher.start",
        "leave it empty: what marks a network must not teach it",
    )
    yield from _exchange(experiment)
    yield from _few_pairs(experiment)
    for name in _posenets(experiment):
        yield from _training(getattr(experiment, name), name, taps)
        yield from _without_pair_losses(getattr(experiment, name), name)
    if over_pins(experiment) or RENDERER in trained(experiment):
        yield from _training(experiment.train_pins, "train_pins", min(pairs, taps))
        for field in ("patch_weight", "label_weight"):
            value = getattr(experiment.train_pins, field)
            yield not value, f"train_pins.{field}", "is for networks over images: leave it at 0"
        yield (
            experiment.train_pins.pose_target in POSE_TARGETS,
            "train_pins.pose_target",
            f"use {' or '.join(POSE_TARGETS)}",
        )


def _exchange(experiment: Experiment) -> Iterator[Rule]:
    """What learning codes that do not leak takes."""
    paired, training = experiment.paired, experiment.train_pins
    shared = isinstance(paired, PairedData) and paired.poses_a_slide > 1 and paired.slides > 1
    for field in ("swap_weight", "agreement_weight"):
        yield getattr(training, field) >= 0, f"train_pins.{field}", "must not be below zero"
        yield not getattr(experiment.train, field), f"train.{field}", "is for networks over pins: leave it at 0"
        yield (
            not getattr(training, field) or (experiment.pins.shear_code > 0 and not experiment.pins.turned),
            f"train_pins.{field}",
            "takes a shear code, and pins as they are: raise pins.shear_code, leave pins.turned at 0",
        )
    yield (
        not training.swap_weight or shared,
        "train_pins.swap_weight",
        "takes simulated slides that poses share, two at least: raise paired.poses_a_slide and paired.slides",
    )


def _few_pairs(experiment: Experiment) -> Iterator[Rule]:
    """What learning from a share of the pairs takes, and from taps without a slide."""
    simulated, over_images, training = recorded_of(experiment) is None, experiment.train, experiment.train_pins
    for name, share in (("train", over_images.paired_share), ("train_pins", training.paired_share)):
        yield 0 < share <= 1, f"{name}.paired_share", "use a share above 0, at most 1"
        yield share == 1 or simulated, f"{name}.paired_share", "is of simulated pairs: use paired.labelled"
    yield (
        training.paired_share == 1 or not (training.swap_weight or training.agreement_weight),
        "train_pins.paired_share",
        "leaves slides without their partners: leave it at 1, or swap_weight and agreement_weight at 0",
    )
    for field in ("tap_weight", "alike_weight"):
        weight = getattr(training, field)
        yield weight >= 0, f"train_pins.{field}", "must not be below zero"
        yield not getattr(over_images, field), f"train.{field}", "is for networks over pins: leave it at 0"
        yield (
            not weight or (simulated and not experiment.pins.turned),
            f"train_pins.{field}",
            "takes simulated pins as they are: leave it at 0, or pins.turned",
        )
    yield (
        not training.alike_weight or (isinstance(experiment.paired, PairedData) and experiment.paired.slides > 1),
        "train_pins.alike_weight",
        "takes two slides to a pose: raise paired.slides",
    )


def _posenets(experiment: Experiment) -> list[str]:
    taught = TEACHER in trained(experiment) and not over_pins(experiment)
    return ["train_posenet", "train_teacher"] if taught else ["train_posenet"]


def _without_pair_losses(training: Training, name: str) -> Iterator[Rule]:
    for field in PAIR_LOSSES:
        value, unused = getattr(training, field), getattr(Training(), field)
        yield value == unused, f"{name}.{field}", f"is for networks that unshear: leave it at {_plain(unused)}"


def _plain(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _known_networks(experiment: Experiment) -> Iterator[Rule]:
    unknown = ", ".join(name for name in experiment.networks if name not in ALL_NETWORKS)
    yield not unknown, "networks", f"network {unknown} is unknown: use {', '.join(ALL_NETWORKS)}"
    yield len(experiment.networks) > 0, "networks", f"name at least one of {', '.join(ALL_NETWORKS)}"
    yield len(set(experiment.networks)) == len(experiment.networks), "networks", "name each network once"
    over = ", ".join(name for name in experiment.networks if name not in PIN_NETWORKS)
    yield (
        not over_pins(experiment) or not over,
        "networks",
        f"{over} reads images alone: with unshear.input pins use {', '.join(PIN_NETWORKS)}",
    )


def _tests(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    yield from _known_networks(experiment)
    unknown = ", ".join(name for name in experiment.unseen if name not in STIMULUS_NAMES)
    yield not unknown, "unseen", f"stimulus {unknown} is unknown: use {', '.join(STIMULUS_NAMES)}"
    known = {*paired.stimuli, *pose.stimuli}
    seen = ", ".join(name for name in experiment.unseen if name in known)
    yield not seen, "unseen", f"{seen} is trained on: name it in one place only"
    yield len(set(experiment.unseen)) == len(experiment.unseen), "unseen", "name each stimulus once"
    for field in FURTHER:
        names = [f"{value:g}" for value in getattr(experiment, field)]  # they name their tests
        yield len(set(names)) == len(names), field, "name each once"
        for data in (data for name, data in further_tests(experiment).items() if name.startswith(FURTHER[field])):
            for holds, _, remedy in (*_ranges(data.ranges, "", experiment.sensor), *_jitter(data, experiment.sensor)):
                yield holds, field, remedy
            try:
                wrong = "" if of_ranges(experiment.targets, data.ranges) else "leaves nothing to predict"
            except UserError as error:
                wrong = str(error)
            yield not wrong, field, wrong
    most = pose.ranges.tilt_deg
    remedy = f"goes beyond pose.ranges.tilt_deg ({most:g}), where PoseNet knows no pose: widen that one, too"
    read = bool({"posenet", TEACHER} & set(trained(experiment)))
    yield not read or max(experiment.other_tilts_deg, default=0) <= most, "other_tilts_deg", remedy


def _targets(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    yield from _target_texts(experiment.targets, SIMULATED)
    flat = SURFACE in {*paired.stimuli, *pose.stimuli, *experiment.unseen}
    named = {text.partition(":")[0] for text in experiment.targets}
    remedy = f"a surface shows depth and tilt alone: name of {', '.join(sorted(OF_SURFACE))}"
    yield not flat or (bool(named) and named <= OF_SURFACE), "targets", remedy
    for ranges in (paired.ranges, pose.ranges):
        try:
            known, wrong = of_ranges(experiment.targets, ranges), ""
        except UserError as error:
            known, wrong = (), str(error)
        yield not wrong, "targets", wrong
        yield len(known) > 0, "targets", "there is none: the ranges of the poses leave nothing to predict"


def _target_texts(targets: tuple[str, ...], known: Mapping[str, object]) -> Iterator[Rule]:
    names = []
    for text in targets:
        try:
            wrong = ""
            names.append(parsed(text, known)[0])
        except UserError as error:
            wrong = str(error)
        yield not wrong, "targets", wrong
    yield len(set(names)) == len(names), "targets", "name each once"


def _same_targets(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    """PoseNet, which learns from taps, is judged by the poses of pairs; a teacher's outputs are compared one by one."""
    pairs, taps = (of_ranges(experiment.targets, part.ranges) for part in (paired, pose))
    remedy = f"pairs vary {', '.join(names_of(pairs))} and taps {', '.join(names_of(taps))}: name those that both vary"
    yield names_of(pairs) == names_of(taps), "targets", remedy
    for pair, tap in zip(pairs, taps, strict=False):
        remedy = f"{pair.name} goes round a circle in taps alone, and a teacher reads both: write {pair.name}:circle"
        yield TEACHER not in trained(experiment) or pair.circle == tap.circle, "targets", remedy


def _train_poses(data: PairedData | PoseData) -> int:
    """Of all stimuli."""
    return sum(train_poses(data.seed, name, data.poses) for name in data.stimuli)


def _name(text: str) -> bool:
    return re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}", text) is not None


def _seed(seed: int) -> bool:
    return 0 <= seed < 2**31


def _sensor(sensor: Sensor) -> Iterator[Rule]:
    for holds, field, remedy in sensor_rules(sensor):
        yield holds, f"sensor.{field}", remedy


def _data(data: PairedData | PoseData, group: str, sensor: Sensor) -> Iterator[Rule]:
    known = CONFIGS[set_name(data)]
    yield (
        data.config in known,
        f"{group}.config",
        f"is no stored configuration: use one of {', '.join(known)}; changed fields get a name of their own",
    )
    yield len(data.stimuli) > 0, f"{group}.stimuli", f"name at least one of {', '.join(STIMULUS_NAMES)}"
    unknown = ", ".join(name for name in data.stimuli if name not in STIMULUS_NAMES)
    yield not unknown, f"{group}.stimuli", f"stimulus {unknown} is unknown: use {', '.join(STIMULUS_NAMES)}"
    yield len(set(data.stimuli)) == len(data.stimuli), f"{group}.stimuli", "name each stimulus once"
    yield (
        data.poses >= BLOCK,
        f"{group}.poses",
        f"use at least {BLOCK}, so that each of the three splits gets a pose",
    )
    yield _seed(data.seed), f"{group}.seed", "use an integer from 0 to 2147483647"
    yield (
        data.friction is None or data.friction >= 0,
        f"{group}.friction",
        "use 0 or more, or none for each material's own",
    )
    yield from _ranges(data.ranges, f"{group}.ranges", sensor)
    yield from _camera(data.camera, f"{group}.camera", sensor)
    yield from _nuisance(data.nuisance, f"{group}.nuisance", data.camera)
    yield from _preprocess(data.preprocess, f"{group}.preprocess", data.camera)


def _paired(data: PairedData, sensor: Sensor) -> Iterator[Rule]:
    yield from _data(data, "paired", sensor)
    yield data.taps >= 1, "paired.taps", "use at least 1: a sheared image needs a tap to pair with"
    yield data.poses_a_slide >= 1, "paired.poses_a_slide", "use at least 1: a slide belongs to one pose at least"
    yield data.slides >= 1, "paired.slides", "use at least 1: without slides there is nothing to unshear"
    yield data.taps <= data.slides, "paired.taps", f"exceeds paired.slides ({data.slides}): some would never be paired"
    yield from _jitter(data, sensor)


def _jitter(data: PairedData, sensor: Sensor) -> Iterator[Rule]:
    jitter, ranges = data.tap_depth_jitter_mm, data.ranges
    yield (
        0 <= jitter <= ranges.depth_min_mm,
        "paired.tap_depth_jitter_mm",
        f"use 0 to ranges.depth_min_mm ({ranges.depth_min_mm:g}), or a tap may miss the stimulus",
    )
    deepest = deepest_touch_mm(sensor, ranges.tilt_deg)
    yield (
        ranges.depth_max_mm + jitter <= deepest,
        "paired.tap_depth_jitter_mm",
        f"with ranges.depth_max_mm ({ranges.depth_max_mm:g}) it cannot be reached: together at most {deepest:.1f} mm",
    )


def _pose(data: PoseData, sensor: Sensor) -> Iterator[Rule]:
    yield from _data(data, "pose", sensor)


def _ranges(ranges: Ranges, group: str, sensor: Sensor) -> Iterator[Rule]:
    dome, deepest = sensor.dome_radius_mm, deepest_touch_mm(sensor, ranges.tilt_deg)
    yield (
        0 <= ranges.lateral_mm <= dome,
        f"{group}.lateral_mm",
        f"use 0 to {dome:g} (the dome's radius): beyond it the target is not touched",
    )
    yield 0 <= ranges.yaw_deg <= 180, f"{group}.yaw_deg", "use 0 to 180"
    edge = contact_angle(sensor)
    yield 0 <= ranges.tilt_deg < edge, f"{group}.tilt_deg", f"use 0 to below {edge:.0f}, where the dome's contact ends"
    yield (
        ranges.depth_min_mm > 0,
        f"{group}.depth_min_mm",
        "must be above zero: at its top or above it the stimulus is not touched",
    )
    yield (
        ranges.depth_min_mm <= ranges.depth_max_mm,
        f"{group}.depth_min_mm",
        f"must not exceed depth_max_mm ({ranges.depth_max_mm:g})",
    )
    leaning = f" at a tilt of {ranges.tilt_deg:g} deg: use less of either" if ranges.tilt_deg else ""
    yield (
        ranges.depth_max_mm <= deepest,
        f"{group}.depth_max_mm",
        f"this depth cannot be reached: a dome of radius {dome:g} mm goes to {deepest:.1f} mm{leaning}",
    )
    yield 0 <= ranges.move_mm <= dome, f"{group}.move_mm", f"use 0 to {dome:g} (the dome's radius)"
    yield 0 <= ranges.twist_deg <= MOST_TWIST_DEG, f"{group}.twist_deg", f"use 0 to {MOST_TWIST_DEG:g}"


def _camera(camera: Camera, group: str, sensor: Sensor) -> Iterator[Rule]:
    yield SMALLEST_PX <= camera.frame_px <= LARGEST_PX, f"{group}.frame_px", f"use {SMALLEST_PX} to {LARGEST_PX}"
    yield camera.mm_across > 0, f"{group}.mm_across", "must be above zero"
    yield camera.housing >= 1, f"{group}.housing", "use 1 or more: the housing lies outside the outermost pins"
    yield (
        camera.distance_mm > sensor.dome_radius_mm,
        f"{group}.distance_mm",
        f"must exceed the dome's radius ({sensor.dome_radius_mm:g}): the camera views the pins from above",
    )


def _nuisance(nuisance: Nuisance, group: str, camera: Camera) -> Iterator[Rule]:
    yield 0 <= nuisance.specks <= 1000, f"{group}.specks", "use 0 to 1000"
    for field, most in (("blur_px", camera.frame_px / 8), ("drift_px", camera.frame_px / 4)):
        yield (
            0 <= getattr(nuisance, field) <= most,
            f"{group}.{field}",
            f"use 0 to {most:g} for a frame of {camera.frame_px} px",
        )
    for field in ("noise", "brightness", "drift_brightness"):
        yield 0 <= getattr(nuisance, field) < 1, f"{group}.{field}", "use 0 up to, but not, 1 (fractions of full scale)"


def _preprocess(preprocess: Preprocess, group: str, camera: Camera | None = None) -> Iterator[Rule]:
    yield SMALLEST_PX <= preprocess.size <= LARGEST_PX, f"{group}.size", f"use {SMALLEST_PX} to {LARGEST_PX} px"
    yield (
        camera is None or preprocess.size <= camera.frame_px,
        f"{group}.size",
        f"larger than the camera's frame of {camera.frame_px if camera else 0} px: use a smaller size or a larger camera.frame_px",
    )
    yield 0 < preprocess.block <= 1, f"{group}.block", "use a fraction of the image above 0, at most 1"
    yield -1 < preprocess.offset < 1, f"{group}.offset", "use a fraction of full scale between -1 and 1"
    yield 0 < preprocess.outer_pins <= 0.5, f"{group}.outer_pins", "use a fraction of the image above 0, at most 0.5"
    yield 0 < preprocess.mask_radius <= 1, f"{group}.mask_radius", "use a fraction of the image above 0, at most 1"


def _networks(experiment: Experiment, paired: Preprocess, pose: Preprocess) -> Iterator[Rule]:
    """`paired` and `pose`: how the images of the two sets are prepared."""
    unshear, posenet, pins = experiment.unshear, experiment.posenet, experiment.pins
    yield unshear.input in INPUTS, "unshear.input", f"is unknown: use one of {', '.join(INPUTS)}"
    yield (
        unshear.size == paired.size,
        "unshear.size",
        f"differs from the data set's images: make it and paired.preprocess.size ({paired.size}) equal",
    )
    yield (
        posenet.size == pose.size,
        "posenet.size",
        f"differs from the data set's images: make it and pose.preprocess.size ({pose.size}) equal",
    )
    yield (
        posenet.size == unshear.size,
        "posenet.size",
        f"differs from unshear.size ({unshear.size}): PoseNet also reads the unsheared images",
    )
    for group, widths in (("unshear", unshear.widths), ("posenet", posenet.widths)):
        yield (
            len(widths) > 1 and all(width >= 1 for width in widths),
            f"{group}.widths",
            "list at least two positive numbers",
        )
    halvings = 2 ** len(unshear.widths)
    yield (
        unshear.size % halvings == 0,
        "unshear.size",
        f"is not divisible by {halvings}: each of the {len(unshear.widths)} widths halves the image",
    )
    yield len(posenet.widths) == 5, "posenet.widths", "list five: PoseNet has five convolutions"
    yield posenet.size % 16 == 0, "posenet.size", "is no multiple of 16, which PoseNet's strides and pooling need"
    yield posenet.hidden >= 1, "posenet.hidden", "must be at least 1"
    yield unshear.pose_channels >= 1, "unshear.pose_channels", "must be at least 1"
    yield (
        unshear.disentangled,
        "unshear.disentangled",
        "both networks are trained from these settings: to train one of them use `--networks entangled`",
    )
    yield (
        unshear.shear_channels >= 0,
        "unshear.shear_channels",
        "must not be below zero; 0 builds no shear code",
    )
    yield 0 <= pins.shear_noise < 1, "pins.shear_noise", "use a number from 0 to below 1: z_s lies in (-1, 1)"
    for field in ("hidden", "layers", "pose_code"):
        yield getattr(pins, field) >= 1, f"pins.{field}", "must be at least 1"
    yield pins.shear_code >= 0, "pins.shear_code", "must not be below zero; 0 builds no shear code"
    yield pins.noise_px >= 0, "pins.noise_px", "must not be below zero"
    yield 0 <= pins.turned <= 1, "pins.turned", "use a share from 0 to 1"
    yield not pins.turned or over_pins(experiment), "pins.turned", "is for networks over pins: leave it at 0"
    yield (
        not pins.turned or recorded_of(experiment) is None or "posenet_sheared" in trained(experiment),
        "pins.turned",
        "is for posenet_sheared, which this experiment does not train: add it to networks, or leave it at 0",
    )
    named = {text.partition(":")[0] for text in experiment.targets}
    yield (
        not pins.turned or recorded_of(experiment) is not None or (bool(named) and named <= TURNED),
        "pins.turned",
        f"turns touches about the sensor's axis, which leaves them these targets alone: {', '.join(sorted(TURNED))}",
    )


def _kept_out(experiment: Experiment, paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    """Sets of one seed hold the same poses: a test's would be among PoseNet's taps."""
    for settings in (paired, *further_tests(experiment).values()):
        yield (
            settings.seed != pose.seed or not set(settings.stimuli) & set(pose.stimuli),
            "pose.seed",
            "gives PoseNet the taps of poses that it is tested at: use another",
        )


def _covered(pairs: Ranges, taps: Ranges) -> Iterator[Rule]:
    for field in ("lateral_mm", "yaw_deg", "depth_max_mm", "tilt_deg"):
        most = getattr(taps, field)
        remedy = f"goes beyond pose.ranges.{field} ({most:g}), where PoseNet knows no pose: widen that one, too"
        yield getattr(pairs, field) <= most, f"paired.ranges.{field}", remedy
    least = taps.depth_min_mm
    remedy = f"is below pose.ranges.depth_min_mm ({least:g}), where PoseNet knows no pose: lower that one, too"
    yield pairs.depth_min_mm >= least, "paired.ranges.depth_min_mm", remedy


def _seen_alike(paired: PairedData, pose: PoseData) -> Iterator[Rule]:
    for group in ("camera", "preprocess"):
        of_pairs, of_taps = getattr(paired, group), getattr(pose, group)
        for field in fields(of_pairs):
            value, name = getattr(of_pairs, field.name), f"{group}.{field.name}"
            yield (
                getattr(of_taps, field.name) == value,
                f"pose.{name}",
                f"differs from paired.{name} ({value:g}): make them equal; PoseNet also reads the images of pairs",
            )


def _training(training: Training, group: str, examples: int) -> Iterator[Rule]:
    yield training.epochs > 0, f"{group}.epochs", "must be above zero"
    yield training.batch >= 1, f"{group}.batch", "must be at least 1"
    yield (
        training.batch <= examples,
        f"{group}.batch",
        f"is larger than the training set of {examples}: use a smaller batch or more poses",
    )
    yield training.optimiser in OPTIMISERS, f"{group}.optimiser", f"is unknown: use one of {', '.join(OPTIMISERS)}"
    yield 0 < training.learning_rate <= 1, f"{group}.learning_rate", "use a number above 0, at most 1"
    yield training.schedule in SCHEDULES, f"{group}.schedule", f"is unknown: use one of {', '.join(SCHEDULES)}"
    drops = training.drops
    yield (
        not drops or training.schedule == "steps",
        f"{group}.drops",
        "have no effect with this schedule: use schedule 'steps'",
    )
    yield (
        all(epoch > 0 and 0 < factor <= 1 for epoch, factor in drops),
        f"{group}.drops",
        "are pairs epoch:factor, the epoch above 0, the factor above 0 and at most 1",
    )
    epochs = [epoch for epoch, _ in drops]
    yield training.precision in PRECISIONS, f"{group}.precision", f"use {' or '.join(PRECISIONS)}"
    yield epochs == sorted(set(epochs)), f"{group}.drops", "must be in the order of their epochs"
    for field in ("beta1", "beta2", "averaging"):
        yield 0 <= getattr(training, field) < 1, f"{group}.{field}", "use 0 up to, but not, 1"
    for field in ("l1", "l2"):
        yield getattr(training, field) >= 0, f"{group}.{field}", "must not be below zero"
    yield training.kernels in KERNELS, f"{group}.kernels", f"is unknown: use one of {', '.join(KERNELS)}"
    yield 0 <= training.shift <= 0.25, f"{group}.shift", "use a fraction of the image, 0 to 0.25"
    yield training.validate_every >= 1, f"{group}.validate_every", "must be at least 1"
    yield training.validation_images >= 1, f"{group}.validation_images", "must be at least 1"


def _pair_losses(training: Training, size: int) -> Iterator[Rule]:
    for field in ("patch_weight", "reconstruction_weight", "pose_weight", "label_weight"):
        yield getattr(training, field) >= 0, f"train.{field}", "must not be below zero"
    yield (
        training.pose_target in POSE_TARGETS,
        "train.pose_target",
        f"is unknown: use one of {', '.join(POSE_TARGETS)}",
    )
    yield training.crops >= 1, "train.crops", "must be at least 1; train.patch_weight 0 switches the patch loss off"
    yield 1 <= training.crop_px <= size, "train.crop_px", f"must be 1 to the image's {size} px"
