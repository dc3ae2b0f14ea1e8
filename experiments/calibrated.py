"""Claim: as in the demo, images lose the slide with a sensor, a camera and a friction that were fitted to real recordings.

    jaxunshear run experiments/calibrated.py

Expected on two cores: as long as the demo. Measured with Adam, before Muon: MS-SSIM from about 0.53 to 0.95, and no gain in pose
after these minutes: the fitted skin slips at half the pull, its pins are levers, and a PoseNet that learnt from taps errs by
0.5 mm on sheared images, and as much on unsheared ones.
"""

from jaxunshear.dataset.configs import PAIRED, POSE, sensor_of
from jaxunshear.experiment import Experiment
from jaxunshear.model.settings import UnshearNet
from jaxunshear.training.settings import Training

experiment = Experiment(
    name="calibrated",
    claim="A network takes the slide out of images of a sensor that was fitted to real ones.",
    sensor=sensor_of("calibrated"),
    paired=PAIRED["calibrated"],
    pose=POSE["calibrated"],
    unshear=UnshearNet(widths=(16, 32, 64, 128, 256)),
    train=Training(
        epochs=8,
        batch=8,
        optimiser="muon",
        learning_rate=6e-3,
        shift=0.01,
        reconstruction_weight=0.3,
        validate_every=270,
    ),
    train_posenet=Training(epochs=12, batch=16, optimiser="muon", learning_rate=1.5e-3, shift=0.01, validate_every=375),
)
