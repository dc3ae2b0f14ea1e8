"""Claim: in minutes of training second convolutions at E's inner layers find no more of the pose; three of them less, in more time.

    jaxunshear sweep experiments/residual.py

Expected on two cores: ten minutes a seed beside 3 minutes for the data. The demo's disentangled network by
`unshear.residual`, how many of its encoder's innermost layers have one (0 is the paper's). All see the same images; those with more
layers take longer for them, so the training's time stands beside the errors.
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.sweep.settings import Sweep

DEMO = load_experiment(Path(__file__).with_name("demo.py"))
NETWORKS = ("disentangled", "posenet")

sweep = Sweep(
    name="residual",
    claim="In minutes of training second convolutions at E's inner layers find no more of the pose; three of them less, in more time.",
    base=replace(DEMO, networks=NETWORKS),
    grid=(("unshear.residual", (0, 1, 2, 3)),),
    seeds=(0, 1),
    networks=NETWORKS,
)
