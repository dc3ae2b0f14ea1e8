"""Claim: a PoseNet that learns poses of recorded slides directly, over images, errs less with
another training: one that stops it from overfitting, or a longer one.

    jaxunshear sweep experiments/rivals_images.py --recordings DIR --seeds 0

Rows are trainings of that PoseNet alone. The first is the one of recorded.py. Every training keeps
the checkpoint of the smallest validation loss, so the rows of more epochs also stop early. The
network that unshears learns from slides and taps; with "taps, too" the PoseNet has as many
contacts.

Choose a row by its validation loss, `best_loss` in `rows/ROW/posenet_sheared/summary.json`, not by
the errors in the table, which are of test contacts. Then train it with the network that unshears,
which a PoseNet of taps reads that learns by the same settings; for "15 epochs":

    jaxunshear sweep experiments/recorded.py --recordings DIR --seeds 0,1,2 \
        --train_posenet.epochs 15

Expected: docs/results/rivals_images.json, seed 0: this PoseNet gains from more epochs, and from
taps beside the slides. By validation loss 30 epochs are best. Three seeds of them are in
docs/results/rivals_images_chosen.json, beside a network that unshears: differences are within
chance.
"""

from dataclasses import replace

from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import POSENET_SHEARED
from jaxunshear.config.sweep import Sweep
from jaxunshear.fit import BASE_EXPERIMENT

LONGER = ("train_posenet.epochs", 15.0)
ROWS = {
    "as recorded.py trains": (),
    "15 epochs": (LONGER,),
    "30 epochs": (("train_posenet.epochs", 30.0),),
    "15 epochs, weight decay 1e-6": (LONGER, ("train_posenet.l2", 1e-6)),
    "15 epochs, weight decay 1e-5": (LONGER, ("train_posenet.l2", 1e-5)),
    "15 epochs, 32 hidden units": (LONGER, ("posenet.hidden", 32)),
    "15 epochs, shifts of one pixel": (LONGER, ("train_posenet.shift", 0.008)),
    "taps, too": (("paired.direct_taps", "recorded"),),
    "15 epochs, taps, too": (LONGER, ("paired.direct_taps", "recorded")),
}

sweep = Sweep(
    name="rivals_images",
    claim="What lets a PoseNet that learns slides directly err less, over images.",
    base=replace(BASE_EXPERIMENT, name="rivals_images", train_pins=PIN_TRAINING),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    networks=(POSENET_SHEARED,),
    seeds=(0, 1, 2),
)
