"""Claim: told the pose as well, a network that learns for minutes leaves hardly more of it in the image; told it loudly, less.

    jaxunshear sweep experiments/labels.py

Expected on two cores: ten minutes a seed beside 3 minutes for the data. The demo's disentangled network by the weight of what
a head reads off its pose code, compared with the true pose; 0 is the paper's, whose pairs carry no label. What is left of the pose in the
image is measured by a PoseNet that learnt from taps alone; what the head itself reads stands beside it (`code_learnt`).
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.sweep.settings import Sweep

DEMO = load_experiment(Path(__file__).with_name("demo.py"))
NETWORKS = ("disentangled", "posenet")

sweep = Sweep(
    name="labels",
    claim="Told the pose as well, a network that learns for minutes leaves hardly more of it in the image; told it loudly, less.",
    base=replace(DEMO, networks=NETWORKS),
    grid=(("train.label_weight", (0.0, 0.1, 0.5, 2.0)),),
    seeds=(0, 1),
    networks=NETWORKS,
)
