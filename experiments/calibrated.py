"""Claim: as in the demo, images lose the slide with a sensor, a camera and a friction that were fitted to real recordings.

    jaxunshear run experiments/calibrated.py

Expected on two cores (docs/results/calibrated.json): as long as the demo, MS-SSIM from about 0.53 to 0.954, and no gain in pose
after these minutes: the fitted skin slips at half the pull, its pins are levers, and a PoseNet that learnt from taps errs by
0.5 mm from the edge on sheared images and as much on unsheared ones, in yaw and edge angle by more.
"""

from dataclasses import replace
from pathlib import Path

from jaxunshear.config import load_experiment
from jaxunshear.dataset.configs import PAIRED, POSE, sensor_of

DEMO = load_experiment(Path(__file__).with_name("demo.py"))

experiment = replace(
    DEMO,
    name="calibrated",
    claim="A network takes the slide out of images of a sensor that was fitted to real ones.",
    sensor=sensor_of("calibrated"),
    paired=PAIRED["calibrated"],
    pose=POSE["calibrated"],
)
