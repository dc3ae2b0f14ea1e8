"""Claim: every stage runs and hands its work to the next.

    jaxunshear run experiments/tiny.py

The figures mean nothing: the networks barely start to learn. Expected on two cores: a minute or
two, most of it compilation.
"""

from dataclasses import replace

from jaxunshear.config.configs import PAIRED, POSE
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.training import POSENET_TRAINING, Training

POSENET = replace(POSENET_TRAINING, epochs=2, batch=6, validate_every=4)

experiment = Experiment(
    name="tiny",
    claim="Every stage runs and hands its work to the next.",
    paired=PAIRED["tiny"],
    pose=POSE["tiny"],
    unshear=UnshearNet(widths=(8, 8, 8, 8), pose_channels=8, shear_channels=8),
    posenet=PoseNet(widths=(8, 8, 8, 8, 8), hidden=16),
    train=Training(epochs=2, batch=6, validate_every=4),
    train_posenet=POSENET,
    train_teacher=POSENET,
)
