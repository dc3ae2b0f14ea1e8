"""Claim: if few slides are labelled, it pays to use those without a label, too.

    jaxunshear sweep experiments/few_labels.py --recordings DIR

Over pins. All taps are labelled, but only a share of the slides. Each seed draws that share anew;
smaller shares lie within larger ones. Slides without a label are either left out, or a PoseNet
reads their poses, which has learnt from the labelled ones with rotation augmentation; all slides
are then unsheared to how taps appear at these poses. Rows `sheared_learnt` are of the PoseNet that
learns from the labelled slides directly.

Expected, docs/results/few_labels.json: with a tenth of the labels y .21 mm and Rz 2.9 deg
unsheared, .25 and 3.5 learnt directly; all labels give .18 and 2.4, .17 and 2.2. Its rows took
71 minutes in all, on one or two cores of an AMD EPYC.
"""

from dataclasses import replace

from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinNet
from jaxunshear.config.sweep import Sweep
from jaxunshear.fit import BASE_EXPERIMENT

sweep = Sweep(
    name="few_labels",
    claim="Errors over the share of slides with labels, without and with slides that have none.",
    base=replace(
        BASE_EXPERIMENT,
        name="few_labels",
        unshear=replace(BASE_EXPERIMENT.unshear, input="pins"),
        pins=PinNet(),  # dense layers alone, which train fast
        train_pins=replace(PIN_TRAINING, epochs=40),
    ),
    grid=(
        ("paired.labelled", (0.01, 0.05, 0.1, 0.3, 1.0)),
        (("paired.unlabelled", "pins.rotated_share"), (("left_out", 0.0), ("pseudo_label", 0.8))),
    ),
    seeds=(0, 1, 2),
)
