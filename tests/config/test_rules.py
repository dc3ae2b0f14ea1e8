"""Settings that would be read by nothing, or would spoil what is measured, are refused by name."""

import pytest

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import override_fields
from jaxunshear.config.rules import validate
from jaxunshear.errors import UserError

PLAIN = Experiment(name="plain", claim="none")


def refusal(words: str) -> str:
    with pytest.raises(UserError) as refused:
        validate(override_fields(PLAIN, words.split()))
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize(
    ("field", "value", "default"),
    [
        ("crops", "50", "100"),
        ("crop_px", "10", "20"),
        ("paired_share", "0.1", "1"),
    ],
)
def test_posenets_training_has_no_losses_of_pairs(field, value, default):
    line = refusal(f"--train_posenet.{field} {value}")
    assert line.startswith(f"--train_posenet.{field} ") and line.endswith(
        f"unshear: leave it at {default}"
    )
    if field != "paired_share":
        validate(override_fields(PLAIN, [f"--train.{field}", value]))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--train_posenet.losses.patch 1", "is for a network that unshears: leave it out"),
        ("--train.losses.pose 1", "is for a network that reads poses: leave it out"),
        ("--train.losses.smooth 1", "loss 'smooth' is unknown: use one of supervised, patch"),
        ("--train.losses supervised:1,patch:-1", "must not be below zero"),
        ("--train.losses supervised:0", "name at least one"),
        ("--train.losses supervised", "takes pairs name:weight separated by commas"),
        ("--train.losses.patch x", "takes a number"),
        ("--unshear.input pins --train_pins.losses.patch 1", "is for networks over images"),
    ],
)
def test_losses_that_a_training_cannot_have(words, line):
    assert line in refusal(f"--networks disentangled,posenet {words}")


def test_losses_are_named_together_or_one_by_one():
    words = "--train.losses supervised:1,reconstruction:0.3 --train.losses.patch 0.2"
    losses = override_fields(PLAIN, words.split()).train.losses
    assert losses == {"supervised": 1.0, "reconstruction": 0.3, "patch": 0.2}
    assert "patch" not in override_fields(PLAIN, ["--train.losses.patch", "0"]).train.losses
    with pytest.raises(TypeError, match="do not change"):
        losses["patch"] = 1.0


def test_a_teachers_training_is_judged_where_there_is_one():
    words = ["--train_teacher.batch", "100000"]
    validate(override_fields(PLAIN, words))
    assert refusal(" ".join([*words, "--train.losses.pose_tap 0.1"])).startswith(
        "--train_teacher.batch 100000: "
    )
    assert "leave it at 100" in refusal("--train.losses.pose_tap 0.1 --train_teacher.crops 5")


def test_a_poses_target_is_known_and_on_the_teachers_scale():
    words = ["--train.losses.pose_label", "0.1"]
    validate(override_fields(PLAIN, words))
    assert "make paired.ranges and pose.ranges equal" in refusal(
        " ".join([*words, "--pose.ranges.yaw_deg 60"])
    )


def test_crops_need_not_fit_the_images_of_a_posenet_that_has_none():
    groups = ("paired.preprocess", "pose.preprocess", "unshear", "posenet")
    words = [f"--{group}.size=16" for group in groups]
    validate(override_fields(PLAIN, [*words, "--unshear.widths", "8,8", "--train.crop_px", "8"]))


@pytest.mark.parametrize("group", ["paired", "pose"])
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("camera.mm_across", "60"),
        ("camera.frame_px", "300"),
        ("preprocess.offset", "0.1"),
        ("preprocess.block", "0.2"),
    ],
)
def test_posenet_reads_pairs_that_see_like_its_taps(group, field, value):
    line = refusal(f"--{group}.{field} {value}")
    assert line.startswith(f"--pose.{field} ") and f"differs from paired.{field} (" in line
    validate(override_fields(PLAIN, [f"--paired.{field}", value, f"--pose.{field}", value]))


def test_without_a_posenet_of_taps_pairs_may_see_otherwise():
    words = ["--paired.camera.mm_across", "60", "--networks"]
    validate(override_fields(PLAIN, [*words, "disentangled,posenet_sheared"]))
    assert "differs" in refusal(
        "--paired.camera.mm_across 60 --networks disentangled --train.losses.pose_tap 0.1"
    )


def test_a_tests_poses_are_none_that_posenet_learnt():
    assert "poses that it is tested at" in refusal("--pose.seed 0")
    assert "poses that it is tested at" in refusal("--paired.seed 1")
    assert "poses that it is tested at" in refusal("--other_jitters_mm 1 --pose.seed 1000")
    validate(override_fields(PLAIN, ["--pose.seed", "1000"]))
    validate(
        override_fields(PLAIN, ["--pose.seed", "0", "--networks", "entangled,posenet_sheared"])
    )


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("lateral_mm", 6),
        ("yaw_deg", 60),
        ("depth_max_mm", 6.5),
        ("depth_min_mm", 0.5),
        ("tilt_deg", 5),
    ],
)
def test_posenet_knows_the_poses_of_pairs(field, value):
    assert f"pose.ranges.{field}" in refusal(f"--paired.ranges.{field} {value}")
    validate(
        override_fields(
            PLAIN, [f"--paired.ranges.{field}", str(value), f"--pose.ranges.{field}", str(value)]
        )
    )


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--targets z_mm", "target 'z_mm' is unknown"),
        ("--targets x_mm:circle", "only an angle goes round a circle"),
        ("--targets x_mm,x_mm:range:2", "name each once"),
        (
            "--targets yaw_deg --pose.ranges.yaw_deg 0 --paired.ranges.yaw_deg 0",
            "target 'yaw_deg' does not vary",
        ),
        (
            "--paired.ranges.lateral_mm 0 --paired.ranges.yaw_deg 0 "
            "--networks disentangled,posenet_sheared",
            "there is none: the ranges of the poses leave nothing to predict",
        ),
        (
            "--paired.ranges.yaw_deg 0",
            "pairs vary x_mm, edge_mm, edge_deg and taps x_mm, yaw_deg, edge_mm, edge_deg: "
            "name those that both vary",
        ),
        ("--pose.ranges.yaw_deg 180 --train.losses.pose_tap 1", "write yaw_deg:circle"),
    ],
)
def test_targets_are_those_that_the_data_vary(words, line):
    refused = refusal(words)
    assert refused.startswith("--targets") and line in refused


@pytest.mark.parametrize(
    "words",
    [
        "--targets y_mm,depth_mm,yaw_deg:circle:2",
        "--paired.ranges.yaw_deg 0 --targets x_mm,edge_mm:range:4,edge_deg",
        "--paired.ranges.yaw_deg 0 --networks disentangled,posenet_sheared",
        "--pose.ranges.yaw_deg 180",
        "--pose.ranges.yaw_deg 180 --train.losses.pose_tap 1 --targets x_mm,yaw_deg:circle",
    ],
)
def test_targets_that_all_sets_vary_are_taken(words):
    validate(override_fields(PLAIN, words.split()))


def test_what_a_stimulus_does_not_show_is_no_target():
    words = "--paired.stimuli surface --pose.stimuli surface"
    assert refusal(words).startswith("--targets ")
    validate(override_fields(PLAIN, [*words.split(), "--targets", "depth_mm"]))
    assert "'surface' does not show x_mm" in refusal(f"{words} --targets depth_mm,x_mm")
    leaning = f"{words} --paired.ranges.tilt_deg 10 --pose.ranges.tilt_deg 10"
    validate(
        override_fields(PLAIN, [*leaning.split(), "--targets", "depth_mm,tilt_x_deg,tilt_y_deg"])
    )
    edges = "--paired.stimuli edge --pose.stimuli edge"
    validate(override_fields(PLAIN, edges.split()))
    assert "'edge' does not show y_mm" in refusal(f"{edges} --targets y_mm,yaw_deg")


def test_turned_touches_keep_distance_direction_and_depth_alone():
    words = ["--unshear.input", "pins", "--pins.turned", "1"]
    assert "edge_deg, edge_mm" in refusal(" ".join(words))
    assert "edge_deg, edge_mm" in refusal(" ".join([*words, "--targets", "edge_mm,yaw_deg"]))
    validate(override_fields(PLAIN, [*words, "--targets", "edge_mm,edge_deg:circle,depth_mm"]))
    assert refusal("--pins.turned 1 --targets edge_mm").startswith("--pins.turned ")


def test_a_direct_posenet_that_convolves_reads_pins():
    pins = "--unshear.input pins --pins.direct_convolved"
    validate(override_fields(PLAIN, f"{pins} 4,6 --networks posenet_sheared".split()))
    assert "does not train" in refusal(f"{pins} 4,6 --networks posenet")
    assert "does not train" in refusal("--pins.direct_convolved 4 --networks posenet_sheared")
    assert "list positive numbers" in refusal(f"{pins} 4,0 --networks posenet_sheared")
    assert "list at most four" in refusal(f"{pins} 4,4,4,4,4 --networks posenet_sheared")


@pytest.mark.parametrize("loss", ["counterfactual", "code_agreement", "slide"])
def test_what_codes_that_do_not_leak_take(loss):
    pins = "--unshear.input pins --networks disentangled,posenet"
    shared = f"{pins} --paired.poses_a_slide 2"
    validate(override_fields(PLAIN, f"{shared} --train_pins.losses.{loss} 1".split()))
    assert "raise pins.shear_code" in refusal(
        f"{shared} --pins.shear_code 0 --train_pins.losses.{loss} 1"
    )
    assert "below zero" in refusal(f"{shared} --train_pins.losses.{loss} -1")
    assert "set unshear.apart" in refusal(f"--paired.poses_a_slide 2 --train.losses.{loss} 1")


def test_what_codes_of_images_that_are_apart_take():
    apart = "--networks disentangled,posenet --unshear.apart true"
    assert "raise train.losses.slide" in refusal(apart)
    assert "use pins.apart" in refusal(f"{apart} --unshear.input pins")
    taught = f"{apart} --train.losses.slide 1"
    validate(override_fields(PLAIN, taught.split()))
    assert "raise train.losses.slide and unshear.shear" in refusal(
        f"{taught} --unshear.shear_channels 0"
    )
    assert refusal(f"{taught} --train.losses.counterfactual 1").startswith(
        "--train.losses.counterfactual 1.0: takes simulated slides"
    )
    validate(override_fields(PLAIN, f"{taught} --train.losses.code_agreement 1".split()))
    for loss in ("counterfactual", "code_agreement"):
        words = f"{taught} --paired.poses_a_slide 2 --train.losses.{loss} 1"
        validate(override_fields(PLAIN, words.split()))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--train.paired_share 0", "use a share above 0"),
        ("--unshear.input pins --train_pins.paired_share 1.1", "use a share above 0"),
        ("--train.losses.tap_identity 1", "is for networks over pins"),
        ("--train.losses.consistency 1", "is for networks over pins"),
        ("--train.paired_share 0.1", "is for networks over pins"),
        (
            "--unshear.input pins --paired.slides 1 --train_pins.losses.consistency 1",
            "takes two slides to a pose",
        ),
        ("--unshear.input pins --train_pins.losses.tap_identity -1", "must not be below zero"),
        (
            "--unshear.input pins --targets edge_mm --pins.turned 1 "
            "--train_pins.losses.tap_identity 1",
            "pins as they are",
        ),
        (
            "--unshear.input pins --train_pins.losses.code_agreement 1 "
            "--train_pins.paired_share 0.1",
            "partners",
        ),
    ],
)
def test_fewer_pairs_within_their_limits(words, line):
    networks = "--networks disentangled,posenet"
    assert line in refusal(f"{networks} {words}")
    few = f"{networks} --unshear.input pins --train_pins.losses.tap_identity 1"
    few += " --train_pins.paired_share 0.1"
    validate(override_fields(PLAIN, few.split()))


def test_taps_of_a_tested_pose_teach_no_network():
    pins = "--networks disentangled --unshear.input pins"
    words = f"{pins} --train_pins.losses.pose_label 0 --pose.seed 0"
    validate(override_fields(PLAIN, words.split()))
    assert refusal(f"{words} --train_pins.losses.tap_identity 1").startswith("--pose.seed 0")


def test_exchanged_codes_take_slides_that_poses_share():
    pins = "--unshear.input pins --networks disentangled,posenet"
    for words in (pins, f"{pins} --paired.poses_a_slide 2 --paired.slides 1"):
        assert refusal(f"{words} --train_pins.losses.counterfactual 1").startswith(
            "--train_pins.losses.counterfactual 1.0: takes simulated"
        )
    validate(override_fields(PLAIN, f"{pins} --train_pins.losses.code_agreement 1".split()))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--paired.poses_a_slide 0", "a slide belongs to one pose at least"),
        (
            "--unshear.input pins --networks disentangled --pins.apart true",
            "raise train_pins.losses.slide",
        ),
    ],
)
def test_codes_and_slides_within_their_limits(words, line):
    assert line in refusal(words)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--paired.ranges.twist_deg -1", "--paired.ranges.twist_deg -1.0: use 0 to 90"),
        ("--paired.ranges.twist_deg 91", "use 0 to 90"),
        ("--pose.ranges.tilt_deg 61", "use 0 to below 60, where the dome's contact ends"),
        ("--pose.ranges.tilt_deg 25", "goes to 5.2 mm at a tilt of 25 deg: use less of either"),
        ("--targets tilt_x_deg", "'tilt_x_deg' does not vary"),
        ("--other_twists_deg 5,5.0", "--other_twists_deg 5.0,5.0: name each once"),
        ("--other_twists_deg 100", "--other_twists_deg 100.0: use 0 to 90"),
        ("--other_tilts_deg 5", "goes beyond pose.ranges.tilt_deg (0)"),
        ("--other_tilts_deg 25 --pose.ranges.tilt_deg 10", "cannot be reached"),
        (
            "--targets depth_mm,tilt_x_deg --paired.ranges.tilt_deg 9 --pose.ranges.tilt_deg 9 "
            "--other_tilts_deg 0",
            "--other_tilts_deg 0.0: target 'tilt_x_deg' does not vary",
        ),
    ],
)
def test_twists_and_tilts_within_their_limits(words, line):
    assert line in refusal(words)


def test_twists_and_tilts_that_can_be():
    wide = "--paired.ranges.depth_max_mm 5 --pose.ranges.depth_max_mm 5 --pose.ranges.tilt_deg 25"
    validate(
        override_fields(PLAIN, f"{wide} --other_tilts_deg 0,25 --other_twists_deg 0,20".split())
    )
    validate(
        override_fields(
            PLAIN,
            [
                "--paired.ranges.twist_deg",
                "20",
                "--train.losses.pose_label",
                "1",
            ],
        )
    )
