"""Claim: partners that a renderer draws are worth no less than the nearest recorded taps.

    jaxunshear sweep experiments/pairings.py --recordings DIR --unshear.input pins --train_pins.epochs 40

One row for each way to pair a recorded slide with a tap; the same slides and the same PoseNets in all of them. Recordings with true pairs
take a third: `--paired.pairing pose_id` in an experiment of its own.

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
        BASE_EXPERIMENT, name="pairings", pins=PinNet(), train_pins=PIN_TRAINING
    ),  # dense layers alone: many rows
    grid=(("paired.pairing", ("rendered", "nearest")),),
    seeds=(0, 1, 2),
)
