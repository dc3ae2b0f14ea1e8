"""Claim: what a laboratory loses with fewer labelled slides, for unshearing and for learning poses from slides directly.

    jaxunshear sweep experiments/few_labels.py --recordings DIR

Over pins. All taps are labelled; of the slides a share, drawn at random anew for each seed, smaller shares within the larger ones.

Expected on two cores: three to five minutes for each of the 15 rows. It was not run to its end yet.
"""

from dataclasses import replace

from jaxunshear.fit import BASE
from jaxunshear.sweep.settings import Sweep

sweep = Sweep(
    name="few_labels",
    claim="Errors over the share of slides with labels.",
    base=replace(BASE, name="few_labels", unshear=replace(BASE.unshear, input="pins")),
    grid=(("paired.labelled", (0.01, 0.05, 0.1, 0.3, 1.0)),),
    seeds=(0, 1, 2),
)
