"""Claim: the paper's full weight of L_rec costs minutes of training a little of image and pose; below 0.3 nothing more is gained.

    jaxunshear sweep experiments/reconstruction.py

Expected on two cores: a quarter of an hour a seed beside 3 minutes for the data; between weights of 1 and 0.3 0.002 of
MS-SSIM and 0.04 mm in x (docs/results/reconstruction.json, one seed). The demo's disentangled network by the
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
    claim="The paper's full weight of L_rec costs minutes of training a little of image and pose; below 0.3 nothing more is gained.",
    base=replace(DEMO, networks=("disentangled", "posenet")),
    grid=(("train.reconstruction_weight", (0.03, 0.1, 0.3, 1.0)),),
    seeds=(0, 1),
    networks=("disentangled", "posenet"),
)
