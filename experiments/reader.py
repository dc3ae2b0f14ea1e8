"""Claim: how much of the pose an unsheared image recovers depends on the PoseNet that reads it, not on the image alone.

    jaxunshear sweep experiments/reader.py

Expected on two cores, as measured with flush pins, data version 2.4.0: half an hour a seed
beside 7 minutes for the data; the same images win back 0.84 of what the slide
adds to the error in x with the PoseNet that learnt least, 0.70 with those that learnt most (docs/results/reader.json).
One disentangled network, that of `standard.py`, and its images; what differs is the PoseNet: how many taps it learnt
from, and for how long. All rows of a seed share the network that unshears, which is trained once.
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.sweep.settings import Sweep

STANDARD = load_experiment(Path(__file__).with_name("standard.py"))
NETWORKS = ("disentangled", "posenet")
READER = ("pose.poses", "train_posenet.epochs")

ROWS = {
    "3000 poses, 4 epochs": ((READER, (3000, 4.0)),),
    "3000 poses, 12 epochs": ((READER, (3000, 12.0)),),
    "3000 poses, 24 epochs": ((READER, (3000, 24.0)),),
    "12000 poses, 3 epochs": ((READER, (12000, 3.0)),),
    "12000 poses, 6 epochs": ((READER, (12000, 6.0)),),
}

sweep = Sweep(
    name="reader",
    claim="How much of the pose an unsheared image recovers depends on the PoseNet that reads it, not on the image alone.",
    base=replace(STANDARD, networks=NETWORKS, unseen=(), other_jitters_mm=()),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1),
    networks=NETWORKS,
)
