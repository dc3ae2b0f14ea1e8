"""Claim: a simulator that shows the same pose after several slides, and the same slide at several poses, parts the codes that the paper's
losses leave mixed.

    jaxunshear sweep experiments/parted.py

Over pins, of the sensor that was fitted to recordings. Four poses share four slides, as the sensor feels them. `parted` learns that the
pose code of one slide with the shear code of another draws the contact of just that pose after just that slide, and that equal
poses have equal pose codes. Its shear code has a trunk of its own and is taught the slide, number by number, which a simulator knows, and a
robot that was commanded it; DS, which draws the slide from both, teaches neither code. The other rows leave one of these out, `the paper's
losses` all; in the last the pose that a PoseNet of taps reads off the unsheared pins is taught, too.

Expected: docs/results/parted.json; half an hour on two cores. `jaxunshear ablate runs/sweeps/parted/rows/ROW --leakage` for a full table.
"""

from dataclasses import replace

from jaxunshear.settings.configs import PAIRED, POSE, sensor_of
from jaxunshear.settings.experiment import PINS, Experiment
from jaxunshear.settings.networks import PinNet, UnshearNet
from jaxunshear.settings.sweep import Sweep

ROWS = {
    "parted": (),
    "no exchanged codes": (("train_pins.swap_weight", 0.0),),
    "no agreement": (("train_pins.agreement_weight", 0.0),),
    "one trunk, and DS teaches both codes": (("pins.apart", False),),
    "that, and no slide is taught": (("pins.apart", False), ("train_pins.slide_weight", 0.0)),
    "the paper's losses": (
        (("train_pins.swap_weight", "train_pins.agreement_weight"), (0.0, 0.0)),
        (("pins.apart", "train_pins.slide_weight"), (False, 0.0)),
    ),
    "parted, and poses teach": (("train_pins.pose_weight", 1.0),),
}

sweep = Sweep(
    name="parted",
    claim="Exchanged codes, held to the simulated contact of that pose after that slide, part pose and shear.",
    base=Experiment(
        name="parted",
        claim="Codes that hold what they should, and nothing else.",
        networks=("disentangled", "posenet"),
        targets=("x_mm", "yaw_deg", "edge_mm:range:4", "edge_deg:circle"),
        sensor=sensor_of("parted"),
        paired=PAIRED["parted"],
        pose=POSE["parted"],
        unshear=UnshearNet(input="pins"),
        pins=PinNet(shear_code=2, apart=True),
        train_pins=replace(PINS, epochs=50, pose_weight=0.0, swap_weight=1.0, agreement_weight=0.05, slide_weight=1.0),
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    ablation=True,
)
