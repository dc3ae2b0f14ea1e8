"""Claim: a simulator that shows the same pose after several slides, and the same slide at several
poses, disentangles the codes that the paper's losses leave mixed.

    jaxunshear sweep experiments/parted.py

Over pins, of the sensor that was fitted to recordings. Four poses share four slides in the frame of
the sensor. The first row has two losses of exchanged codes: the pose code of one slide with the
shear code of another must reconstruct the contact of that pose after that slide, and equal poses
must have equal pose codes, in every direction of the code over its variance. Its shear code has an
encoder of its own, which learns the slide: a simulator knows it, and a robot that was commanded it.
DS, which reconstructs the slide from both codes, trains neither. Each other row leaves one of these
out; `the paper's losses` leave out all.

Expected: docs/results/parted.json. For a full table:

    jaxunshear ablate runs/sweeps/parted/rows/ROW --leakage
"""

from dataclasses import replace

from jaxunshear.config.configs import PAIRED, POSE, get_config_sensor
from jaxunshear.config.experiment import PIN_TRAINING, Experiment
from jaxunshear.config.networks import PinNet, UnshearNet
from jaxunshear.config.sweep import Sweep

WEIGHTS = ("train_pins.losses.counterfactual", "train_pins.losses.code_agreement")
ROWS = {
    "disentangled": (),
    "no exchanged codes": (("train_pins.losses.counterfactual", 0.0),),
    "no agreement": (("train_pins.losses.code_agreement", 0.0),),
    "one encoder, and DS teaches both codes": (("pins.separate_encoders", False),),
    "the paper's losses": (
        (WEIGHTS, (0.0, 0.0)),
        (("pins.separate_encoders", "train_pins.losses.slide"), (False, 0.0)),
        ("pins.pose_code", 16),
    ),
}

sweep = Sweep(
    name="parted",
    claim="Exchanged codes and codes that agree disentangle pose and shear.",
    base=Experiment(
        name="parted",
        claim="Codes that hold what they should, and nothing else.",
        networks=("disentangled", "posenet"),
        targets=("x_mm", "yaw_deg", "edge_mm:range:4", "edge_deg:circle"),
        sensor=get_config_sensor("parted"),
        paired=PAIRED["parted"],
        pose=POSE["parted"],
        unshear=UnshearNet(input="pins"),
        pins=PinNet(pose_code=8, shear_code=2, separate_encoders=True),
        train_pins=replace(
            PIN_TRAINING,
            epochs=50,
            losses={
                "supervised": 1.0,
                "reconstruction": 0.3,
                "counterfactual": 1.0,
                "code_agreement": 2.0,
                "slide": 1.0,
            },
        ),
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    ablation=True,
)
