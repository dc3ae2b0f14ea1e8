"""Claim: a tenth of the pairs is enough if there are also taps that no slide belongs to. With
slides that have no tap, even fewer pairs are of use.

    jaxunshear sweep experiments/few_pairs.py

Over pins, of the sensor that was fitted to recordings. A share of the 1,440 training poses has a
tap and four slides: 1 % are 14 poses. Each seed draws the share anew; smaller shares lie within
larger ones. There are three ways. The first learns from pairs alone. The second adds 2,880 taps of
other poses, which must come out of the network as they went in. The third adds slides that have no
tap: two slides to the same pose must be unsheared alike. No way knows a pose: taps and slides need
no label, but the third must know which slides were to one pose.

The 2,880 taps replace 1,296 of the 1,440 pairs' poses, and they are the taps that the scoring
PoseNet learns from. So the two ways are not compared at equal numbers of contacts.

Expected, docs/results/few_pairs.json: with a tenth of the pairs, and taps, errors of 1.1 to 1.2
times those of all pairs and taps; with a hundredth, and slides, of 1.2 to 1.6 times. Its rows took
66 minutes in all, on one or two cores of an Intel Xeon.
"""

from dataclasses import replace

import parted

from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.sweep import Sweep

FIELDS = ("train_pins.losses.tap_identity", "train_pins.losses.consistency")
WAYS = {"pairs alone": (0.0, 0.0), "and taps": (0.5, 0.0), "and slides": (0.5, 1.0)}
SHARES = {1.0: tuple(WAYS)[:2], 0.1: tuple(WAYS), 0.01: tuple(WAYS)}

sweep = Sweep(
    name="few_pairs",
    claim=(
        "Errors over the share of poses whose slides have their tap, "
        "without and with taps that have no slide."
    ),
    base=replace(
        parted.sweep.base,
        name="few_pairs",
        claim="With taps that no slide belongs to, a tenth of the pairs is enough.",
        train_pins=replace(
            PIN_TRAINING,
            epochs=13,
            losses={"supervised": 1.0, "reconstruction": 0.3, "slide": 1.0},
        ),
    ),
    rows=tuple(
        ((("train_pins.paired_share", share), (FIELDS, WAYS[way])))
        for share, ways in SHARES.items()
        for way in ways
    ),
    labels=tuple(f"{share:.0%}, {way}" for share, ways in SHARES.items() for way in ways),
    seeds=(0, 1, 2),
)
