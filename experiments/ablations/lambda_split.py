"""Claim: the paper's weight of the patch loss, lambda = 0.1, and its even split of the channels
between pose and shear code are a fair choice: nothing else on the grid is clearly better.

    jaxunshear sweep experiments/ablations/lambda_split.py

Expected, docs/results/lambda_split.json (its `command` gives this file's earlier place,
experiments/lambda_split.py): the claim holds for lambda. It does not hold for the split: larger
pose codes are a little better. Its rows took 402 minutes in all, each on a core of an Intel Xeon;
one of the 75 took 107 of these, the others 1 to 9 each. There is one PoseNet per seed. For each row
codes are swapped, and what they leak is measured. `runs/sweeps/lambda_split/sweep.png` has a heat
map for every figure. Sensor, images and settings are the demo's, but each network is trained for
four of the demo's five epochs, so compare the rows with each other.
"""

from dataclasses import replace

import demo

from jaxunshear.config.sweep import Sweep

sweep = Sweep(
    name="lambda_split",
    claim=(
        "The paper's weight of the patch loss and its even split of the channels are a fair choice."
    ),
    base=replace(
        demo.experiment,
        unshear=replace(demo.experiment.unshear, pose_channels=64, shear_channels=64),
        train=replace(demo.experiment.train, epochs=4, validate_every=270),
        train_posenet=replace(demo.experiment.train_posenet, epochs=6),
    ),
    grid=(
        ("train.losses.patch", (0.0, 0.01, 0.1, 1.0, 10.0)),
        (
            ("unshear.pose_channels", "unshear.shear_channels"),
            ((8, 120), (32, 96), (64, 64), (96, 32), (120, 8)),
        ),
    ),
    seeds=(0, 1, 2),
    networks=("disentangled", "posenet"),
    ablation=True,
)
