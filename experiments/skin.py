"""Claim: networks that learnt in simulation alone remove most of a slide's turn from recorded pins.

    jaxunshear run experiments/skin.py
    jaxunshear evaluate runs/skin --recordings DIR

Over pins: contacts of the fitted sensor with an edge and three shapes, varied as between sensors,
cameras and days (`--pins.rotated_share`). The released weights `skin`, which `unshear`, `pose` and
`stream` use by default, come from it, by `jaxunshear release runs/skin`.

Expected: minutes to simulate and to train on two cores (no file has the times);
docs/results/skin_released.json for scores of the released weights on recordings of a real edge.
"""

from jaxunshear.config.configs import PAIRED, POSE, get_config_sensor
from jaxunshear.config.experiment import PIN_TRAINING, Experiment
from jaxunshear.config.networks import PinNet, UnshearNet

experiment = Experiment(
    name="skin",
    claim=(
        "Networks that learnt in simulation alone take most of a slide's turn out of recorded pins."
    ),
    networks=("disentangled", "posenet"),
    targets=("edge_mm", "edge_deg:circle", "depth_mm"),
    sensor=get_config_sensor("skin"),
    paired=PAIRED["skin"],
    pose=POSE["skin"],
    unshear=UnshearNet(input="pins"),
    pins=PinNet(conv_channels=(24, 48, 96), noise_px=0.3, rotated_share=1.0),
    train_pins=PIN_TRAINING,
)
