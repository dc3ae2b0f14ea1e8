"""Claim: a loss that looks at the unsheared image through a PoseNet returns a little more of the pose; too much of it, less.

    jaxunshear sweep experiments/taught.py

Expected on two cores: a quarter of an hour a seed beside 3 minutes for the data; at a weight of 0.1 x nearer by 0.04 mm
for 0.002 of MS-SSIM, at 10 no image is left (docs/results/taught.json, one seed). The demo's networks, but that the
disentangled one is also told how far apart the poses lie that a PoseNet reads off its image and off the tap, with a
weight of 0 (the paper's losses) to 10. No label enters: pairs are all it takes. That PoseNet, `posenet_teacher`, learnt
from another seed than the one that measures the pose errors, which a network trained through it could otherwise learn
to please.
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.sweep.settings import Sweep

DEMO = load_experiment(Path(__file__).with_name("demo.py"))
NETWORKS = ("disentangled", "posenet")

sweep = Sweep(
    name="taught",
    claim="A loss seen through a PoseNet returns a little more of the pose; too much of it, less.",
    base=replace(DEMO, networks=NETWORKS),
    grid=(("train.pose_weight", (0.0, 0.1, 1.0, 10.0)),),
    seeds=(0, 1),
    networks=NETWORKS,
)
