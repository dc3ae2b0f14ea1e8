"""Claim: more poses, and a loss seen through a PoseNet leave little of the slide in the pose, at 128 px.

    jaxunshear run experiments/best.py

Expected on two cores: an hour and a half on a fast machine, with light work beside (docs/results/best.json: 69 minutes for
the disentangled network; the data were made apart, in nine more), reckoned three hours on that of the other results; MS-SSIM
0.982, edge distance to 0.25 mm where taps give 0.22. The networks of `standard.py`, but that the disentangled one sees
seven and a half times as many poses, 15 times as many images, and is told how far apart the poses lie that a PoseNet of
its own (`posenet_teacher`) reads off its image and off the tap. Both PoseNets see twice as many taps. The released
weights `best` are of this run.
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.dataset.configs import PAIRED, POSE

STANDARD = load_experiment(Path(__file__).with_name("standard.py"))

experiment = replace(
    STANDARD,
    name="best",
    claim="More poses, and a loss seen through a PoseNet leave little of the slide in the pose, at 128 px.",
    networks=("disentangled", "posenet"),
    paired=PAIRED["best"],
    pose=POSE["best"],
    train=replace(STANDARD.train, epochs=16, pose_weight=0.1),
    train_posenet=replace(STANDARD.train_posenet, epochs=4),
)
