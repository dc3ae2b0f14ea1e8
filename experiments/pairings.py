"""Claim: partners that a renderer draws are worth no less than the nearest recorded taps.

    jaxunshear sweep experiments/pairings.py --recordings DIR --unshear.input pins \
        --train_pins.epochs 40

Each row pairs recorded slides with taps in another way; all rows have the same slides and the same
PoseNets. Recordings with true pairs have a third way: `--paired.pairing pose_id` in an experiment
of its own.

Expected: with 4,000 taps of an edge the renderer's are better by 0.008 mm in y, and no worse in Rz
(docs/results/pairings.json, over pins; the file is of 40 epochs, without the option there are 100).
Its rows took 14 minutes in all, on two cores of an AMD EPYC.
"""

from dataclasses import replace

from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinNet
from jaxunshear.config.sweep import Sweep
from jaxunshear.fit import BASE_EXPERIMENT

sweep = Sweep(
    name="pairings",
    claim="Which partner a recorded slide should have.",
    base=replace(
        BASE_EXPERIMENT,
        name="pairings",
        pins=PinNet(),  # dense layers alone, which train fast
        train_pins=PIN_TRAINING,
    ),
    grid=(("paired.pairing", ("rendered", "nearest")),),
    seeds=(0, 1, 2),
)
