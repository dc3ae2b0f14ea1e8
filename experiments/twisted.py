"""Claim: slides that twist are unsheared as well as slides that do not, once a network was trained
on some; one that was not errs little more.

    jaxunshear sweep experiments/twisted.py

This is the first limit that the paper names: its slides shift the sensor and never turn it. Here
they turn by up to 5 deg, and as an extreme by up to 20. Three networks over pins learn from slides
to the same poses that do not twist, twist by up to 5 and by up to 20 deg. Each is tested on three
sets of slides to other poses, one of each kind. One PoseNet, trained on taps, reads all of them.
The losses are the paper's.

Expected: docs/results/twisted.json. Its rows took 40 minutes in all, on one or two cores of an
Intel Xeon.
"""

from dataclasses import replace

import parted

from jaxunshear.config.configs import PAIRED
from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinNet
from jaxunshear.config.sweep import Sweep

ROWS = {
    "slides that do not twist": (("paired.ranges.twist_deg", 0.0),),
    "slides that twist by 5 deg": (),
    "slides that twist by 20 deg": (("paired.ranges.twist_deg", 20.0),),
}

sweep = Sweep(
    name="twisted",
    claim="Networks that have seen slides twist take the twist out of pins.",
    base=replace(
        parted.sweep.base,
        name="twisted",
        claim="The twist of a slide is learnt like its shift.",
        other_twists_deg=(0.0, 5.0, 20.0),
        paired=PAIRED["twisted"],
        pins=PinNet(),
        train_pins=replace(PIN_TRAINING, losses={"supervised": 1.0, "reconstruction": 0.3}),
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    reference="slides that do not twist",
)
