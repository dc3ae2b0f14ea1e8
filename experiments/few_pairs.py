"""Claim: with taps that no slide belongs to, a tenth of the pairs is enough.

    jaxunshear sweep experiments/few_pairs.py

Over pins, of the sensor that was fitted to recordings. A share of the 1,440 training poses, drawn at random anew for each seed, smaller
shares within the larger ones, has a tap and four slides; the slides of the other poses have no tap, and are left out: 1 % are 14 poses.
Two ways: these pairs alone; or beside them, each time as many as half of them, taps of other poses, those that PoseNet learns from, which
must come out of the network as they went in. Neither way knows a pose: the taps need no label, the other slides are not used.

Expected: docs/results/few_pairs.json; half an hour on a core.
"""

from dataclasses import replace

from jaxunshear.dataset.configs import PAIRED, POSE, sensor_of
from jaxunshear.experiment import PINS, Experiment
from jaxunshear.model.settings import PinNet, UnshearNet
from jaxunshear.sweep.settings import Sweep

sweep = Sweep(
    name="few_pairs",
    claim="Errors over the share of poses whose slides have their tap, without and with taps that have no slide.",
    base=Experiment(
        name="few_pairs",
        claim="With taps that no slide belongs to, a tenth of the pairs is enough.",
        networks=("disentangled", "posenet"),
        targets=("x_mm", "yaw_deg", "edge_mm:range:4", "edge_deg:circle"),
        sensor=sensor_of("parted"),
        paired=PAIRED["parted"],
        pose=POSE["parted"],
        unshear=UnshearNet(input="pins"),
        pins=PinNet(shear_code=2, apart=True, shear_noise=0.1),
        train_pins=replace(PINS, epochs=20, pose_weight=0.0),
    ),
    grid=(
        ("train_pins.paired_share", (1.0, 0.1, 0.01, 0.05)),
        ("train_pins.tap_weight", (0.0, 0.5)),
    ),
    seeds=(0, 1, 2),
)
