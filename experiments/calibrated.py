"""Claim: of a sensor that was fitted to real recordings, minutes of training take the slide out of images, and not out of the pose that is
read off them.

    jaxunshear run experiments/calibrated.py

The demo with the sensor, the camera and the friction that were fitted. Expected (docs/results/calibrated.json, one seed, seven minutes on
two cores): MS-SSIM 0.954 (sheared 0.561), but edges are read hardly better than off the slides, at 0.40 mm (tap 0.23, sheared 0.43) and
10.4 deg (7.0, 9.4). The fitted skin slips at half the pull and its pins are levers, so slides mislead a PoseNet less than the demo's do.
Half an hour of training, experiments/standard.py, undoes more. The page compares it with the demo's bars and says where it misses.
"""

from dataclasses import replace

import demo

from jaxunshear.settings.configs import PAIRED, POSE, sensor_of

experiment = replace(
    demo.experiment,
    name="calibrated",
    claim="Minutes of training take the slide out of images of a fitted sensor, and not out of the pose read off them.",
    sensor=sensor_of("calibrated"),
    paired=PAIRED["calibrated"],
    pose=POSE["calibrated"],
)
