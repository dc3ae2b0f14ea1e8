"""Claim: while some of the skin still sticks, both codes together predict the slide's shift to
about 0.1 mm and its turn to 0.7 deg; disentangled codes do no worse than those of the paper's
losses.

    jaxunshear sweep experiments/slide_read.py

The networks of `parted.py`, with its losses and with the paper's, learn from slides that turn by up
to 5 deg. If all of the skin slips, the length of the slide does not show in the image; contacts
with and without skin that sticks have figures of their own.

Expected: docs/results/slide_read.json. Its rows took 15 minutes in all, each on a core of an AMD
EPYC.
"""

from dataclasses import replace

import parted

from jaxunshear.config.sweep import Sweep

BASE = parted.sweep.base
TWISTS = (("paired.ranges.twist_deg", 5.0),)
ROWS = {"parted": TWISTS, "the paper's losses": (*parted.ROWS["the paper's losses"], *TWISTS)}

sweep = Sweep(
    name="slide_read",
    claim="How far a slide went is read from the codes while some of the skin sticks.",
    base=replace(
        BASE,
        name="slide_read",
        pins=replace(BASE.pins, shear_code=3),  # a slide with a turn has three numbers
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    ablation=True,
    reference="parted",
)
