"""Claim: a tenth of the paper's data.

    jaxunshear run experiments/paper_tenth.py

Expected
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.dataset.configs import PAIRED, POSE, sensor_of

PAPER = load_experiment(Path(__file__).with_name("paper.py"))

experiment = replace(
    PAPER,
    name="paper_tenth",
    networks=("disentangled",),
    claim="Appendix B learns, on a tenth of the paper's data.",
    sensor=sensor_of("paper_tenth"),
    paired=PAIRED["paper_tenth"],
    pose=POSE["paper_tenth"],
    train=replace(PAPER.train, epochs=24, validate_every=50, validation_images=128),
)
