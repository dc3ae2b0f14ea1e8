"""Claim: half of the images seen in a mirror add nothing to minutes of training, which lack epochs and not poses.

    jaxunshear sweep experiments/mirror.py

Expected on two cores: ten minutes a seed beside 3 minutes for the data. The demo's networks with and without `mirror`: its
sensor and its shapes are their own mirror images, so what a mirror shows is another touch that could have been, but for specks and
drift of the camera (docs/model.md). Each of the two trainings with and without it, so that what the reader gains is told from what
the image does.
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.sweep.settings import Sweep

DEMO = load_experiment(Path(__file__).with_name("demo.py"))
NETWORKS = ("disentangled", "posenet")

sweep = Sweep(
    name="mirror",
    claim="Half of the images seen in a mirror add nothing to minutes of training, which lack epochs and not poses.",
    base=replace(DEMO, networks=NETWORKS),
    grid=(("train.mirror", (False, True)), ("train_posenet.mirror", (False, True))),
    seeds=(0, 1),
    networks=NETWORKS,
)
