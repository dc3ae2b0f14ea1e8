"""Claim: of what appendix B's "L1/L2 regularization (10e-4)" can mean, the mean over each kernel
trains best; with its sum the kernels shrink first. "10:1" is a weight of 0.1 on the patch loss, not
of 10.

    jaxunshear sweep experiments/ablations/appendix_b.py --seeds 0,1,2

Expected, docs/results/appendix_b.json (its `command` gives this file's earlier place,
experiments/appendix_b.py): 7 to 11 minutes of training for each of fifteen rows on a core of an
Intel Xeon, after the pairs of experiments/calibrated.py are made. Its rows took 185 minutes in all.
It is experiments/paper.py at 128 px with batches of 8 for 1,350 steps. That is early: no row beats
the mean tap's MS-SSIM yet, so the rows say how well a reading starts to learn.
`docs/make_curves.py` draws the rows' kernels and losses.
"""

from dataclasses import replace

import paper

from jaxunshear.config.configs import PAIRED, POSE, get_config_sensor
from jaxunshear.config.sweep import Sweep

WEIGHTS = ("train.l1", "train.l2")

sweep = Sweep(
    name="appendix_b",
    claim="Of what appendix B's regularization can mean, the mean over each kernel trains best.",
    base=replace(
        paper.experiment,
        networks=("disentangled",),
        other_jitters_mm=(),
        sensor=get_config_sensor("calibrated"),
        paired=PAIRED["calibrated"],
        pose=POSE["calibrated"],
        unshear=replace(paper.experiment.unshear, size=128),
        posenet=replace(paper.experiment.posenet, size=128),
        # 1,350 steps
        train=replace(
            paper.experiment.train, epochs=5, batch=8, validate_every=75, validation_images=64
        ),
    ),
    grid=(
        (WEIGHTS, ((1e-4, 1e-4), (1e-3, 1e-3))),
        ("train.kernels", ("sum", "mean")),
    ),
    rows=((("train.losses.patch", 10.0),),),
    labels=("lambda 10",),
    seeds=(0, 1, 2),
)
