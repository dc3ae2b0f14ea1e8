"""Claim: if no slide was recorded, simulated slides to recorded taps undo half of what a slide adds
to the error in Rz, two fifths in y and nothing in depth.

    jaxunshear sweep experiments/simulated_slides.py --recordings DIR

Over pins. One row learns from simulated slides: the contact simulator computes how a slide would
move the pins of recorded taps. The other learns from recorded slides, each with the tap that a
renderer draws at its pose. Both are tested on recorded slides. Rows `sheared_learnt` are of a
PoseNet that learns from the same slides directly.

Expected: docs/results/simulated_slides.json. Its rows took 49 minutes in all, on two cores of an
AMD EPYC.
"""

from dataclasses import replace

from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinNet
from jaxunshear.config.sweep import Sweep
from jaxunshear.fit import BASE_EXPERIMENT

sweep = Sweep(
    name="simulated_slides",
    claim="What simulated slides to recorded taps are worth, beside recorded slides.",
    base=replace(
        BASE_EXPERIMENT,
        name="simulated_slides",
        unshear=replace(BASE_EXPERIMENT.unshear, input="pins"),
        pins=PinNet(),  # dense layers alone, which train fast
        train_pins=replace(PIN_TRAINING, epochs=40),
    ),
    grid=(("paired.pairing", ("simulated", "rendered")),),
    seeds=(0, 1, 2),
)
