"""Claim: minutes of training on simulated pairs remove most of a slide's effect from an image. The
simulated pins are flush with the skin, which those of a real sensor are not.

    jaxunshear run experiments/demo.py          # `make demo` does this after setting up

Expected on poses never trained on: MS-SSIM to the tap of at least 0.90 (0.45 at most for the
sheared image itself), and a PoseNet trained on taps whose errors in edge distance and edge angle
are at most 0.6 times as large on the unsheared images as on the sheared ones. Measured
(docs/results/demo.json, two cores of an Intel Xeon): four seeds took 8 to 9 minutes each after the
data were made, one took 20. On two idle cores of an AMD EPYC `make demo` took 7 minutes, with
installs.

The friction is 0.7. With the fitted sensor of calibrated.py, training of the same length undoes
less of the slide's damage: 15 % in edge distance, where the demo undoes 69 %
(docs/results/calibrated.json, one seed; demo.json, five). We think that pins as levers are the
reason, because they show how the skin turns at an edge; this was not tested.
"""

from dataclasses import replace

from jaxunshear.config.configs import PAIRED, POSE, get_config_sensor
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import UnshearNet
from jaxunshear.config.training import POSENET_TRAINING, Training

POSENET = replace(
    POSENET_TRAINING,
    epochs=8,
    batch=16,
    optimiser="muon",
    learning_rate=1.5e-3,
    shift=0.01,
    validate_every=375,
)

experiment = Experiment(
    name="demo",
    claim="Minutes of training on simulated pairs take most of the slide out of a tactile image.",
    sensor=get_config_sensor("demo"),
    paired=PAIRED["demo"],
    pose=POSE["demo"],
    unshear=UnshearNet(widths=(16, 32, 64, 128, 256)),
    train=Training(
        epochs=5,
        batch=8,
        optimiser="muon",
        learning_rate=6e-3,
        shift=0.01,
        losses={"supervised": 1.0, "patch": 0.1, "reconstruction": 0.3},
        validate_every=270,
    ),
    train_posenet=POSENET,
    train_teacher=POSENET,
)
