"""Claim: while some of the skin still sticks, both codes together say how far a slide went to 0.15 mm, and how far it turned to 1 deg;
codes that part say it no worse than those of the paper's losses.

    jaxunshear sweep experiments/slide_read.py

The networks of `parted.py`, with its losses and with the paper's, learn from slides that turn by up to 5 deg on their way. Where all of the
skin slips, how far a slide went does not show in its image; the figures are given for both kinds apart.

Expected: docs/results/slide_read.json; a quarter of an hour on two cores.
"""

from dataclasses import replace

import parted

from jaxunshear.settings.sweep import Sweep

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
