"""Claim: the more the encoder is made to tell of the slide, the less its few minutes leave for the canonical image.

    jaxunshear sweep experiments/reconstruction.py

Expected on two cores: a quarter of an hour a seed beside 3 minutes for the data. The demo's disentangled network by the
weight of L_rec, the loss of the sheared image that DS draws: 1 is the paper's, 0.3 the demo's. Beside each row's image and
pose errors stand DS' own, with both codes and with the pose code alone.
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.sweep.settings import Sweep

DEMO = load_experiment(Path(__file__).with_name("demo.py"))

sweep = Sweep(
    name="reconstruction",
    claim="The more the encoder is made to tell of the slide, the less its few minutes leave for the canonical image.",
    base=replace(DEMO, networks=("disentangled", "posenet")),
    grid=(("train.reconstruction_weight", (0.03, 0.1, 0.3, 1.0)),),
    seeds=(0, 1),
    networks=("disentangled", "posenet"),
)
