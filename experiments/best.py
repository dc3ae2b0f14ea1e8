"""Claim: more poses, and a loss seen through a PoseNet leave little of the slide in the pose, at 128 px.

    jaxunshear run experiments/best.py

Expected on two cores: some hours; not measured on today's data. Sensor and networks of `standard.py`, but that the disentangled one
sees seven and a half times as many poses, 15 times as many images, and is given how far apart the poses lie that a PoseNet
of its own (`posenet_teacher`) reads off its image and off the tap. Both PoseNets see six times as many poses; the one that
is evaluated five times as many images.
"""

from dataclasses import replace

import standard

from jaxunshear.settings.configs import PAIRED, POSE

experiment = replace(
    standard.experiment,
    name="best",
    claim="More poses, and a loss seen through a PoseNet leave little of the slide in the pose, at 128 px.",
    networks=("disentangled", "posenet"),
    paired=PAIRED["best"],
    pose=POSE["best"],
    train=replace(standard.experiment.train, epochs=16, pose_weight=0.1),
    train_posenet=replace(standard.experiment.train_posenet, epochs=10),
    train_teacher=replace(standard.experiment.train_teacher, epochs=4),
)
