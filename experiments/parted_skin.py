"""Claim: what parts the codes of simulated touches parts those of recorded ones.

    jaxunshear sweep experiments/parted_skin.py --recordings DIR

Over pins. A recording has no two slides that are known to be alike, and no pose under several slides; what is left of parted.py is that the
pose code of a slide agrees with that of its tap, and that the shear code has a trunk of its own and is taught the slide as it is labelled.
Both rows learn from true poses, too, as recorded.py does.

Expected: docs/results/parted_skin.json; half an hour on a core. For a full table

    jaxunshear ablate runs/sweeps/parted_skin/rows/ROW --leakage
"""

from dataclasses import replace

from jaxunshear.fit import BASE
from jaxunshear.settings.experiment import PINS
from jaxunshear.settings.networks import PinNet
from jaxunshear.settings.sweep import Sweep

sweep = Sweep(
    name="parted_skin",
    claim="What parts the codes of simulated touches parts those of recorded ones.",
    base=replace(
        BASE,
        name="parted_skin",
        unshear=replace(BASE.unshear, input="pins"),
        pins=PinNet(),  # dense layers alone, as in parted.py
        train_pins=replace(PINS, epochs=40),
    ),
    rows=(
        (),
        (
            (("pins.apart", "pins.shear_code"), (True, 5)),  # the slide's numbers: two shifts, three turns
            (("train_pins.agreement_weight", "train_pins.slide_weight"), (0.05, 1.0)),
        ),
    ),
    labels=("as recorded.py trains", "parted"),
    networks=("disentangled", "posenet"),
    seeds=(0, 1, 2),
    ablation=True,
)
