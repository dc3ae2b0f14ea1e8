"""Claim: three times the poses and a loss seen through a PoseNet leave little of the slide in the pose, at 128 px.

    jaxunshear run experiments/best.py

Expected on two cores: an hour and a quarter, 12 minutes of it for the data. The networks of `standard.py`, but that the
disentangled one sees three times as many poses, for half an hour, and is told how far apart the poses lie that a PoseNet
of its own (`posenet_teacher`) reads off its image and off the tap.
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.dataset.configs import PAIRED, POSE
from jaxunshear.experiment import TEACHER

STANDARD = load_experiment(Path(__file__).with_name("standard.py"))

experiment = replace(
    STANDARD,
    name="best",
    claim="Three times the poses and a loss seen through a PoseNet leave little of the slide in the pose, at 128 px.",
    networks=(TEACHER, "disentangled", "posenet"),
    paired=PAIRED["best"],
    pose=POSE["best"],
    train=replace(STANDARD.train, epochs=11, pose_weight=0.1),
)
