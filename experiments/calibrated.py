"""Claim: as in the demo, images lose the slide with a sensor, a camera and a friction that were fitted to real recordings.

    jaxunshear run experiments/calibrated.py

Expected on two cores: as long as the demo. The fitted skin slips at half the pull and its pins are levers, so slides mislead a PoseNet
less than the demo's do, and minutes of training undo less. Not measured since data version 3.0.0: experiments/standard.py, of the same
sensor, is. The page compares it with the demo's bars and says where it misses.
"""

from dataclasses import replace

import demo

from jaxunshear.settings.configs import PAIRED, POSE, sensor_of

experiment = replace(
    demo.experiment,
    name="calibrated",
    claim="A network takes the slide out of images of a sensor that was fitted to real ones.",
    sensor=sensor_of("calibrated"),
    paired=PAIRED["calibrated"],
    pose=POSE["calibrated"],
)
