"""Claim: longer training helps more than a wider network, and more than larger images except for
pins; Muon helps more than Adam.

    jaxunshear sweep experiments/frontier.py

Expected, docs/results/frontier.json: edge distance error 0.37 mm after twice the epochs, 0.41 for a
network twice as wide, 0.66 for Adam at the best of three rates. Its rows took 107 minutes in all,
on two cores of an Intel Xeon. Each row is the demo's disentangled network but for what its label
says. `runs/sweeps/frontier/sweep.png` shows mean errors against mean seconds of training and
against milliseconds per image, and marks the settings that no other one beats. The tables of the
pages give medians of seconds and milliseconds.
"""

from dataclasses import replace

import demo

from jaxunshear.config.sweep import Sweep

IMAGES = [
    f"{group}.{field}"
    for group in ("paired", "pose")
    for field in ("preprocess.size", "camera.frame_px")
]
SIZES = (*IMAGES, "unshear.size", "posenet.size", "train.crop_px")

ROWS = {
    "base": (),
    "a quarter of the epochs": (("train.epochs", 1),),
    "half the epochs": (("train.epochs", 2),),
    "twice the epochs": (("train.epochs", 8),),
    "half as wide": (("unshear.widths", (8, 16, 32, 64, 128)),),
    "twice as wide": (("unshear.widths", (32, 64, 128, 256, 512)),),
    "Adam, rate 0.001": (("train.optimiser", "adam"), ("train.learning_rate", 1e-3)),
    "Adam, rate 0.003": (("train.optimiser", "adam"), ("train.learning_rate", 3e-3)),
    "Adam, rate 0.01": (("train.optimiser", "adam"), ("train.learning_rate", 1e-2)),
    "256 px": (
        (SIZES, (256, 256, 256, 256, 256, 256, 40)),
        ("unshear.widths", (16, 32, 64, 128, 256, 256)),
    ),
}

sweep = Sweep(
    name="frontier",
    claim=(
        "Longer training buys more than a wider network, and than larger images in all but the "
        "pins; Muon more than Adam."
    ),
    base=replace(
        demo.experiment,
        train=replace(demo.experiment.train, epochs=4, validate_every=270),
        train_posenet=replace(demo.experiment.train_posenet, epochs=6),
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    networks=("disentangled", "posenet"),
)
