"""Claim: appendix B, as experiments/paper.py reads it, learns to unshear from a tenth of the paper's taps and slides.

    jaxunshear run experiments/paper_tenth.py

The disentangled network alone, at 256 px, of the sensor, camera and friction that were fitted to recordings: 200 poses of each of
three shapes with 5 taps and 15 slides, and the paper's 100 epochs with its drops of the learning rate. Expected,
docs/results/paper_tenth.json: MS-SSIM 0.93 against taps of the slide's own depth (sheared 0.59, best translation 0.81), 0.89 against
taps that miss it by up to 1 mm, as the paper pairs them. Five minutes on an H100; on a CPU core nine hours.
"""

from dataclasses import replace

import paper

from jaxunshear.settings.configs import PAIRED, POSE, sensor_of

experiment = replace(
    paper.experiment,
    name="paper_tenth",
    claim="Appendix B learns to unshear from a tenth of the paper's taps and slides.",
    sensor=sensor_of("paper_tenth"),
    paired=PAIRED["paper_tenth"],
    pose=POSE["paper_tenth"],
    train=replace(paper.experiment.train, validate_every=845, validation_images=10_000),  # five epochs; the entire set
)
