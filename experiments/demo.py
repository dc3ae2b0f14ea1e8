"""Claim: minutes of training on simulated pairs take most of the slide out of an image; the pins are flush, as no real skin's.

    jaxunshear run experiments/demo.py          # `make demo` does this after setting up

Expected on two cores, within 10 minutes (half as much again where the machine is busy), on poses never trained on: MS-SSIM to the tap of
at least 0.90 (0.45 at most for the sheared image itself), and a PoseNet trained on taps that errs, in edge distance and edge
angle, at most 0.6 times as much on the unsheared images as on the sheared ones.

Its pins end flush with the skin and its friction is 0.7. Pins as levers, which real ones are (calibrated.py and standard.py have
them), show how the skin turns at an edge, and so much of the pose is read from a sheared image that minutes of training undo a
third of what is lost, not half and more.
"""

from jaxunshear.settings.configs import PAIRED, POSE, sensor_of
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.networks import UnshearNet
from jaxunshear.settings.training import Training

POSENET = Training(epochs=8, batch=16, optimiser="muon", learning_rate=1.5e-3, shift=0.01, validate_every=375)

experiment = Experiment(
    name="demo",
    claim="Minutes of training on simulated pairs take most of the slide out of a tactile image.",
    sensor=sensor_of("demo"),
    paired=PAIRED["demo"],
    pose=POSE["demo"],
    unshear=UnshearNet(widths=(16, 32, 64, 128, 256)),
    train=Training(
        epochs=5,
        batch=8,
        optimiser="muon",
        learning_rate=6e-3,
        shift=0.01,
        reconstruction_weight=0.3,
        validate_every=270,
    ),
    train_posenet=POSENET,
    train_teacher=POSENET,
)
