"""Claim: appendix B, as experiments/paper.py reads it, learns from a tenth of the paper's data; it does not end with it.

    jaxunshear run experiments/paper_tenth.py

The disentangled network alone, at 256 px, of the sensor, camera and friction that were fitted to recordings: 200 poses of each of
three shapes with 5 taps and 15 slides, and 24 epochs of 169 steps, all before the paper's first drop of the learning rate.
Expected on one core, docs/results/paper_tenth.json: two hours of training; MS-SSIM 0.82 (sheared 0.60, mean tap 0.69), validation
loss still falling. Slides are paired as in the paper, with taps that miss their depth by up to 1 mm; the test against taps of their own
depth stands apart.
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
    claim="Appendix B learns, on a tenth of the paper's data; it does not end with it.",
    sensor=sensor_of("paper_tenth"),
    paired=PAIRED["paper_tenth"],
    pose=POSE["paper_tenth"],
    train=replace(PAPER.train, epochs=24, validate_every=50, validation_images=128),
)
