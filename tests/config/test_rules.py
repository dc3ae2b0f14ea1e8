"""Settings that would be read by nothing, or would spoil what is measured, are refused by name."""

import pytest

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import override_fields
from jaxunshear.config.rules import validate
from jaxunshear.errors import UserError

PLAIN = Experiment(name="plain", claim="none")
PAIR = "--networks disentangled,posenet"
PINS = f"{PAIR} --unshear.input pins"
SHARED = f"{PINS} --paired.poses_a_slide 2"
TURNED = "--unshear.input pins --pins.rotated_share 1"
CONVOLVED = "--unshear.input pins --pins.direct_conv_channels"
APART = f"{PAIR} --unshear.separate_encoders true"
TAUGHT = f"{APART} --train.losses.slide 1"
SURFACE = "--paired.stimuli surface --pose.stimuli surface"
LEAN = "--paired.ranges.tilt_deg 9 --pose.ranges.tilt_deg 9"
DEEP = "--paired.ranges.depth_max_mm 5 --pose.ranges.depth_max_mm 5 --pose.ranges.tilt_deg 25"
SMALL = " ".join(
    f"--{group}.size=16" for group in ("paired.preprocess", "pose.preprocess", "unshear", "posenet")
)

# fields whose value is out of its bounds, whatever the others are
OUT_OF_BOUNDS = """
train.epochs 0, train.epochs -3, train.epochs inf, train.batch 0, train.learning_rate -0.001,
train.learning_rate nan, train.learning_rate 0, train.beta1 1,
train.ema_decay 1.5, train.l1 -1, train.kernels norm, train.shift 0.7, train.validate_every 0,
train.optimiser sgd, train.validation_images 0, train.crop_px 129, paired.poses 0, pose.poses -1,
paired.slides 0, paired.taps 0, paired.seed -1, seed 3000000000, paired.ranges.depth_min_mm 0,
paired.ranges.move_mm -1, paired.ranges.yaw_deg 200, paired.ranges.lateral_mm 100,
paired.ranges.depth_max_mm 25, pose.ranges.depth_max_mm 10.5, paired.tap_depth_jitter_mm 2,
paired.preprocess.size 0, paired.preprocess.size 512, paired.preprocess.block 0,
paired.preprocess.outer_pins 0, paired.camera.distance_mm 10, pose.nuisance.noise 2,
sensor.gel_poisson 0.5, sensor.pin_radius_mm 1, sensor.rings 40, sensor.layout square,
unshear.size 64, posenet.size 64, unshear.widths 8, posenet.widths 8-8, name a/b
"""
REFUSED = {
    "one field": [
        ("--paired.taps 3 --paired.slides 2", "--paired.taps 3: exceeds slides (2)"),
        ("--train.drops 80:0.1,40:0.2", "in the order"),
        ("--train.drops 40:2", "--train.drops 40.0:2.0"),
        ("--paired.stimuli disk,box", "box is unknown: use one of disk, clover"),
        ("--paired.stimuli=", "name at least one"),
        ("--paired.stimuli disk,disk", "each stimulus once"),
        ("--paired.config standard", "a configuration is chosen by the experiment's file"),
        ("--paired.ranges.depth_min_mm 7", "must not exceed depth_max_mm (6)"),
        ("--other_jitters_mm 1,1.0", "name each once"),
        (f"{SMALL.replace('=16', '=72')} --paired.preprocess.size 72", "not divisible by 32"),
        ("--unshear.widths 8,0", "list positive numbers"),
        ("--unshear.disentangled false", "use `--networks entangled`"),
        ("--name=", "names the folder"),
    ],
    "losses": [
        (f"{PAIR} --train_posenet.losses.patch 1", "is for a network that unshears: leave it out"),
        (f"{PAIR} --train.losses.pose 1", "is for a network that reads poses: leave it out"),
        ("--train.losses.smooth 1", "loss 'smooth' is unknown: use one of supervised, patch"),
        ("--train.losses supervised:1,patch:-1", "must not be below zero"),
        ("--train.losses supervised:0", "name at least one"),
        ("--train.losses supervised", "takes pairs name:weight separated by commas"),
        ("--train.losses.patch x", "takes a number"),
        (f"{PINS} --train_pins.losses.patch 1", "is for networks over images"),
        (f"{PAIR} --train.losses.tap_identity 1", "is for networks over pins"),
        (
            f"{PINS} --paired.slides 1 --train_pins.losses.consistency 1",
            "takes two slides to a pose",
        ),
        (
            f"{PINS} --targets edge_mm --pins.rotated_share 1 --train_pins.losses.tap_identity 1",
            "pins as they are",
        ),
        (f"{PINS} --train_pins.losses.counterfactual 1", "takes simulated slides"),
        (
            f"{SHARED} --paired.slides 1 --train_pins.losses.counterfactual 1",
            "--train_pins.losses.counterfactual 1.0: takes simulated slides",
        ),
        ("--train.losses.pose_label 0.1 --pose.ranges.yaw_deg 60", "pose.ranges equal"),
    ],
    "settings that change no network": [
        *(
            (f"--train_posenet.{field} {value}", f"trains: leave it at {default}")
            for field, value, default in (("crops", 5, 100), ("crop_px", 9, 20))
        ),
        ("--train_posenet.paired_share 0.1", "leave it at 1"),
        ("--train.paired_share 0.1", "leave it at 1"),
        (f"{PINS} --train_pins.rotated_below 9", "set it to 0"),
        ("--train_posenet.rotated_below 9", "leave it at 0"),
        ("--train.losses.pose_tap 0.1 --train_teacher.crops 5", "leave it at 100"),
        (f"{CONVOLVED} 4,6 --networks posenet", "changes none of the networks"),
        (
            "--pins.direct_conv_channels 4 --networks posenet_sheared",
            "changes none of the networks",
        ),
        ("--pins.rotated_share 1 --targets edge_mm", "changes none of the networks"),
    ],
    "batches": [
        ("--train_teacher.batch 100000 --train.losses.pose_tap 0.1", "--train_teacher.batch 1"),
        ("--train.batch 100000", "is larger than the training set of 2160"),
        ("--train_posenet.batch 100000", "is larger than the training set of 4320"),
    ],
    "codes": [
        (f"{CONVOLVED} 4,0 --networks posenet_sheared", "list positive numbers"),
        (f"{CONVOLVED} 4,4,4,4,4 --networks posenet_sheared", "list at most four"),
        *(
            (f"{SHARED} --pins.shear_code 0 --train_pins.losses.{loss} 1", "raise pins.shear_code")
            for loss in ("counterfactual", "code_agreement", "slide")
        ),
        ("--paired.poses_a_slide 2 --train.losses.slide 1", "set unshear.separate_encoders"),
        (APART, "raise train.losses.slide"),
        (f"{TAUGHT} --unshear.shear_channels 0", "the size of the shear code"),
        (f"{TAUGHT} --train.losses.counterfactual 1", "takes simulated slides"),
        (f"{PINS} --pins.separate_encoders true", "raise train_pins.losses.slide"),
        ("--train.paired_share 0", "use a share above 0"),
        (f"{PINS} --train_pins.losses.code_agreement 1 --train_pins.paired_share 0.1", "partners"),
    ],
    "posenet and the pairs": [
        *(
            (f"--{group}.{field} {value}", f"--pose.{field} ")
            for group in ("paired", "pose")
            for field, value in (
                ("camera.mm_across", 60),
                ("camera.frame_px", 300),
                ("preprocess.offset", 0.1),
            )
        ),
        (
            "--paired.camera.mm_across 60 --networks disentangled --train.losses.pose_tap 0.1",
            "differs from paired.camera.mm_across (60)",
        ),
        ("--pose.seed 0", "poses that it is tested at"),
        ("--other_jitters_mm 1 --pose.seed 1000", "poses that it is tested at"),
        (
            f"{PINS} --networks disentangled --train_pins.losses.pose_label 0 --pose.seed 0 "
            "--train_pins.losses.tap_identity 1",
            "--pose.seed 0",
        ),
        *(
            (f"--paired.ranges.{field} {value}", f"pose.ranges.{field}")
            for field, value in (
                ("lateral_mm", 6),
                ("yaw_deg", 60),
                ("depth_max_mm", 6.5),
                ("depth_min_mm", 0.5),
                ("tilt_deg", 5),
            )
        ),
    ],
    "targets": [
        ("--targets z_mm", "--targets z_mm: target 'z_mm' is unknown"),
        ("--targets x_mm:circle", "only an angle goes round a circle"),
        ("--targets x_mm,x_mm:range:2", "name each once"),
        ("--targets tilt_x_deg", "'tilt_x_deg' does not vary"),
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
        (SURFACE, "'surface' does not show edge_deg, edge_mm, x_mm, yaw_deg"),
        (f"{SURFACE} --targets depth_mm,x_mm", "'surface' does not show x_mm"),
        (TURNED, "edge_deg, edge_mm"),
        (f"{TURNED} --targets edge_mm,yaw_deg", "edge_deg, edge_mm"),
        (f"--targets depth_mm,tilt_x_deg {LEAN} --other_tilts_deg 0", "does not vary"),
    ],
    "slides and tilts": [
        ("--paired.poses_a_slide 0", "must be at least 1"),
        ("--paired.ranges.twist_deg -1", "--paired.ranges.twist_deg -1.0: use 0 to 90"),
        ("--pose.ranges.tilt_deg 61", "use 0 to below 60, where the dome's contact ends"),
        ("--pose.ranges.tilt_deg 25", "goes to 5.2 mm at a tilt of 25 deg"),
        ("--other_twists_deg 5,5.0", "--other_twists_deg 5.0,5.0: name each once"),
        ("--other_twists_deg 100", "--other_twists_deg 100.0: use 0 to 90"),
        ("--other_tilts_deg 5", "goes beyond pose.ranges.tilt_deg (0)"),
        ("--other_tilts_deg 25 --pose.ranges.tilt_deg 10", "cannot be reached"),
    ],
}
ACCEPTED = [
    "--train.crops 50 --train.crop_px 10",
    "--train_teacher.batch 100000",
    "--train.losses.pose_label 0.1",
    f"{SMALL} --unshear.widths 8,8 --train.crop_px 8",
    "--paired.camera.mm_across 60 --pose.camera.mm_across 60",
    "--paired.camera.mm_across 60 --networks disentangled,posenet_sheared",
    "--pose.seed 1000",
    "--pose.seed 0 --networks entangled,posenet_sheared",
    "--pose.seed 0 --networks disentangled --unshear.input pins --train_pins.losses.pose_label 0",
    "--paired.ranges.lateral_mm 6 --pose.ranges.lateral_mm 6",
    "--targets y_mm,depth_mm,yaw_deg:circle:2",
    "--paired.ranges.yaw_deg 0 --targets x_mm,edge_mm:range:4,edge_deg",
    "--paired.ranges.yaw_deg 0 --networks disentangled,posenet_sheared",
    "--pose.ranges.yaw_deg 180 --train.losses.pose_tap 1 --targets x_mm,yaw_deg:circle",
    f"{SURFACE} --targets depth_mm",
    f"{SURFACE} {LEAN} --targets depth_mm,tilt_x_deg,tilt_y_deg",
    "--paired.stimuli edge --pose.stimuli edge",
    f"{PINS} --pins.rotated_share 1 --targets edge_mm,edge_deg:circle,depth_mm",
    f"{CONVOLVED} 4,6 --networks posenet_sheared",
    f"{SHARED} --train_pins.losses.counterfactual 1",
    f"{PINS} --train_pins.losses.code_agreement 1",
    f"{TAUGHT} --train.losses.code_agreement 1",
    f"{TAUGHT} --paired.poses_a_slide 2 --train.losses.counterfactual 1",
    f"{PINS} --train_pins.losses.tap_identity 1 --train_pins.paired_share 0.1",
    f"{DEEP} --other_tilts_deg 0,25 --other_twists_deg 0,20",
    "--paired.ranges.twist_deg 20 --train.losses.pose_label 1",
]


@pytest.mark.parametrize(("words", "line"), [case for cases in REFUSED.values() for case in cases])
def test_a_setting_that_cannot_work_is_refused_by_name(words, line):
    with pytest.raises(UserError) as refused:
        validate(override_fields(PLAIN, words.split()))
    assert line in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("words", OUT_OF_BOUNDS.replace("\n", " ").split(","))
def test_a_value_out_of_its_bounds_is_refused_with_a_remedy(words):
    field, value = words.split()
    with pytest.raises(UserError, match=rf"^--{field} .*\w") as refused:
        validate(override_fields(PLAIN, [f"--{field}", value.replace("8-8", "8,8")]))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("words", ACCEPTED)
def test_settings_that_can_work_are_accepted(words):
    validate(override_fields(PLAIN, words.split()))


def test_losses_are_named_together_or_one_by_one():
    words = "--train.losses supervised:1,reconstruction:0.3 --train.losses.patch 0.2"
    losses = override_fields(PLAIN, words.split()).train.losses
    assert losses == {"supervised": 1.0, "reconstruction": 0.3, "patch": 0.2}
    assert "patch" not in override_fields(PLAIN, ["--train.losses.patch", "0"]).train.losses
    with pytest.raises(TypeError, match="do not change"):
        losses["patch"] = 1.0
