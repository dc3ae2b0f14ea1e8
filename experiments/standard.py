"""Claim: with an evening's training instead of minutes, the unsheared image comes closer to the tap than in the demo.

    jaxunshear run experiments/standard.py

Expected on two cores: some hours, most of it training; MS-SSIM above the demo's, and smaller pose errors. The same at a
tenth of the data: `--paired.poses 40 --pose.poses 300`.
"""

from jaxunshear.dataset.configs import PAIRED, POSE
from jaxunshear.experiment import Experiment
from jaxunshear.training.settings import Training

experiment = Experiment(
    name="standard",
    claim="An evening's training brings the unsheared image closer to the tap than the demo's minutes do.",
    paired=PAIRED["standard"],
    pose=POSE["standard"],
    train=Training(epochs=20, batch=8, learning_rate=2e-3, validate_every=1000),
    train_posenet=Training(epochs=20, batch=64, validate_every=200),
)
