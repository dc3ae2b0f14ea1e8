"""Claim: what disentangles the codes of pins disentangles those of images.

    jaxunshear sweep experiments/parted_images.py

The contacts are those of parted.py, as images. Both codes are vectors of a few numbers, without
place. The shear code is the slide, two numbers, and has an encoder of its own. The pose codes of
two slides to one pose agree, in every direction of the code over its variance. DS, which
reconstructs the slide from both, trains neither. The other rows leave out agreement, or all of it:
the last has the paper's losses, and codes as large as the paper's.

Expected: the figures are still to be measured; 45 minutes per seed on a core.
"""

from dataclasses import replace

import parted
import standard

from jaxunshear.config.networks import PinNet
from jaxunshear.config.sweep import Sweep
from jaxunshear.config.training import Training

ROWS = {
    "disentangled": (),
    "no agreement": (("train.losses.code_agreement", 0.0),),
    "the paper's losses": (
        (
            ("unshear.separate_encoders", "unshear.pose_channels", "unshear.shear_channels"),
            (False, 256, 256),
        ),
        (("train.losses.code_agreement", "train.losses.slide"), (0.0, 0.0)),
    ),
}

sweep = Sweep(
    name="parted_images",
    claim="Agreement, and a shear code that is the slide, disentangle codes of images.",
    base=replace(
        parted.sweep.base,
        name="parted_images",
        unshear=replace(
            standard.experiment.unshear, pose_channels=8, shear_channels=2, separate_encoders=True
        ),
        pins=PinNet(),
        train=replace(
            standard.experiment.train,
            epochs=4,
            losses={**standard.experiment.train.losses, "code_agreement": 2.0, "slide": 1.0},
        ),
        train_pins=Training(),
        train_posenet=standard.experiment.train_posenet,
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    ablation=True,
)
