"""Claim: codes over pins of a real sensor are disentangled, by the strongest of five families of
probes.

    jaxunshear sweep experiments/parted_skin.py --recordings DIR

A recording has no two slides that are known to be alike, and no pose under several slides. So the
pose code of a slide agrees with that of its tap, in every direction of the code over its variance.
The shear code has an encoder of its own, and learns the two shifts of the slide as they are
labelled: the pins show next to nothing of its turns. All rows also learn from true poses, as
recorded.py does.

Weight of agreement and sizes of the codes were chosen on validation contacts of seed 0.
Expected: docs/results/parted_skin.json. For a full table:

    jaxunshear ablate runs/sweeps/parted_skin/rows/ROW --leakage
"""

from dataclasses import replace

from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinNet
from jaxunshear.config.sweep import Sweep
from jaxunshear.fit import BASE_EXPERIMENT

WEIGHTS = ("train_pins.losses.code_agreement", "train_pins.losses.slide")
CODES = ("pins.separate_encoders", "pins.pose_code", "pins.shear_code")
ROWS = {
    "as recorded.py trains": (),
    "disentangled": ((CODES, (True, 8, 2)), (WEIGHTS, (2.0, 1.0))),
    "disentangled, codes of 16 and 5 numbers": ((CODES, (True, 16, 5)), (WEIGHTS, (2.0, 1.0))),
    "no agreement": ((CODES, (True, 8, 2)), (WEIGHTS, (0.0, 1.0))),
}

sweep = Sweep(
    name="parted_skin",
    claim="Codes over pins of a real sensor are disentangled.",
    base=replace(
        BASE_EXPERIMENT,
        name="parted_skin",
        unshear=replace(BASE_EXPERIMENT.unshear, input="pins"),
        pins=PinNet(),  # dense layers alone, as in parted.py
        train_pins=replace(PIN_TRAINING, epochs=40),
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    networks=("disentangled", "posenet"),
    seeds=(0, 1, 2),
    ablation=True,
)
