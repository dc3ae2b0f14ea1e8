"""Claim: of the readings of appendix B's "L1/L2 regularization (10e-4)", some train the networks and some hold them at their start.

    jaxunshear sweep experiments/appendix_b.py --seeds 0,1,2

Expected
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.dataset.configs import PAIRED, POSE, sensor_of
from jaxunshear.sweep.settings import Sweep

PAPER = load_experiment(Path(__file__).with_name("paper.py"))
WEIGHTS = ("train.l1", "train.l2")

sweep = Sweep(
    name="appendix_b",
    claim="What appendix B's regularization can mean, and what of it trains.",
    base=replace(
        PAPER,
        networks=("disentangled",),
        other_jitters_mm=(),
        sensor=sensor_of("calibrated"),
        paired=PAIRED["calibrated"],
        pose=POSE["calibrated"],
        unshear=replace(PAPER.unshear, size=128),
        posenet=replace(PAPER.posenet, size=128),
        train=replace(PAPER.train, epochs=5, batch=8, validate_every=75, validation_images=64),  # 1,350 steps
    ),
    grid=(
        (WEIGHTS, ((1e-4, 1e-4), (1e-3, 1e-3))),
        ("train.kernels", ("sum", "mean")),
    ),
    rows=((("train.patch_weight", 10.0),),),
    labels=("lambda 10",),
    seeds=(0, 1, 2),
)
