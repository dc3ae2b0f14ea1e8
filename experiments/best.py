"""Claim: more poses, and a loss seen through a PoseNet leave little of the slide in the pose, at 128 px.

    jaxunshear run experiments/best.py

Expected on two cores, as measured with light work beside (docs/results/best.json): two hours, 19 minutes of it for the
data, 81 for the disentangled network; MS-SSIM 0.980, edge distance to 0.25 mm where taps give 0.22. The networks of
`standard.py`, but that the disentangled one sees seven and a half times as many poses, eight times as long, and is told
how far apart the poses lie that a PoseNet of its own (`posenet_teacher`) reads off its image and off the tap. Both
PoseNets see twice as many taps. The released weights `best` are of this run.
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
    train=replace(STANDARD.train, epochs=9, pose_weight=0.1),
    train_posenet=replace(STANDARD.train_posenet, epochs=8),
)
