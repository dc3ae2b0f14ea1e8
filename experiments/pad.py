"""Claim: on a flat pad of gel, too, most of a slide's damage to poses can be undone.

    jaxunshear run experiments/pad.py
    jaxunshear sweep experiments/pad.py --seeds 0,1,2

No recording of such a pad is at hand, so this one is simulated: an elastic layer on a plate, with
165 markers in 11 rows. It touches an edge and three shapes. The networks are over markers.

Expected: docs/results/pad.json, from the sweep.
"""

from jaxunshear.config.configs import PAIRED, POSE, get_config_sensor
from jaxunshear.config.experiment import PIN_TRAINING, Experiment
from jaxunshear.config.networks import UnshearNet

experiment = Experiment(
    name="pad",
    claim="On a flat pad of gel, too, most of a slide's damage to poses can be undone.",
    networks=("disentangled", "posenet", "posenet_sheared"),
    targets=("edge_mm", "edge_deg:circle", "depth_mm"),
    sensor=get_config_sensor("pad"),
    paired=PAIRED["pad"],
    pose=POSE["pad"],
    unshear=UnshearNet(input="pins"),
    train_pins=PIN_TRAINING,
)
