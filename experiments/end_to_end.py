"""Claim: from images end to end, over pins, errors on unsheared edges are about 1.2 times a tap's
own if the encoder convolves and true poses supervise it a little; without these poses they are
larger.

    jaxunshear sweep experiments/end_to_end.py

The network is that of `parted.py`, with four times its poses and images of 256 px. It learns from
the simulator's true pins, with as much noise as detected pins have. It is also scored on pins that
are detected in images with noise and drift, each image by itself (test `found`). While it trains, a
PoseNet of taps reads its unsheared pins, and its predictions should be the true pose (the loss
`pose_label`); another PoseNet, which supervises nothing, reads them in the test. `posenet_sheared`
learns poses from the same slides directly: it shows how much of the pose such a network still finds
in a slide.

Expected: docs/results/end_to_end.json. Its rows took 163 minutes in all, on one or two cores of an
AMD EPYC; the simulation of 67,000 contacts comes before them.
"""

from dataclasses import replace

import parted

from jaxunshear.config.configs import PAIRED, POSE
from jaxunshear.config.sweep import Sweep

BASE = parted.sweep.base
ROWS = {
    "E convolves, poses teach": (),
    "E convolves": (("train_pins.losses.pose_label", 0.0),),
    "E is dense": ((("train_pins.losses.pose_label", "pins.conv_channels"), (0.0, ())),),
}

sweep = Sweep(
    name="end_to_end",
    claim=(
        "An encoder that convolves, and poses that teach, "
        "bring unsheared edges nearer to a tap's own."
    ),
    base=replace(
        BASE,
        name="end_to_end",
        networks=(*BASE.networks, "posenet_sheared"),
        paired=PAIRED["end_to_end"],
        pose=POSE["end_to_end"],
        unshear=replace(BASE.unshear, size=256),
        posenet=replace(BASE.posenet, size=256),
        # the noise is as large as the errors of pins that are detected in these images
        pins=replace(BASE.pins, conv_channels=(16, 32, 64), noise_px=0.14),
        train_pins=replace(
            BASE.train_pins, epochs=25, losses={**BASE.train_pins.losses, "pose_label": 0.1}
        ),
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    ablation=True,
)
