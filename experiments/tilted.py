"""Claim: a network trained with an upright sensor alone fails if the sensor leans; one trained with
a leaning sensor undoes half of the damage.

    jaxunshear sweep experiments/tilted.py

The sensor leans by up to 25 deg in any direction, from the first touch to the slide's end. Depths
are 1 to 5 mm, the greatest that it can reach at that angle. Two networks over pins learn from
slides to the same places, one with the sensor upright, one with it leaning; both are tested on
slides to other places, upright and leaning. One PoseNet, trained on leaning taps, reads all of
them.

Expected: docs/results/tilted.json. Its rows took 21 minutes in all, on two cores of an Intel Xeon.
"""

from dataclasses import replace

import parted

from jaxunshear.config.configs import PAIRED, POSE
from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinNet
from jaxunshear.config.sweep import Sweep

ROWS = {"an upright sensor": (("paired.ranges.tilt_deg", 0.0),), "a sensor that leans": ()}

sweep = Sweep(
    name="tilted",
    claim="Networks that have seen the sensor lean unshear it leaning.",
    base=replace(
        parted.sweep.base,
        name="tilted",
        claim="A slide of a leaning sensor is learnt like one of an upright one.",
        other_tilts_deg=(0.0, 25.0),
        paired=PAIRED["tilted"],
        pose=POSE["tilted"],
        pins=PinNet(),
        train_pins=replace(PIN_TRAINING, losses={"supervised": 1.0, "reconstruction": 0.3}),
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    reference="an upright sensor",
)
