"""Claim: what parts the codes of pins parts those of images.

    jaxunshear sweep experiments/parted_images.py

The contacts of parted.py, as images. Both codes are a few numbers without place. The shear code is the slide, two numbers, and has an
encoder of its own; the pose codes of two slides to one pose agree; DS, which draws the slide from both, teaches neither. The other
rows leave out agreement, or all of it: the last has the paper's losses, and codes as large as the paper's.

Expected: docs/results/parted_images.json; half an hour a seed on a core.
"""

from dataclasses import replace

import parted
import standard

from jaxunshear.settings.networks import PinNet
from jaxunshear.settings.sweep import Sweep
from jaxunshear.settings.training import Training

ROWS = {
    "parted": (),
    "no agreement": (("train.agreement_weight", 0.0),),
    "the paper's losses": (
        (("unshear.apart", "unshear.pose_channels", "unshear.shear_channels"), (False, 256, 256)),
        (("train.agreement_weight", "train.slide_weight"), (0.0, 0.0)),
    ),
}

sweep = Sweep(
    name="parted_images",
    claim="Agreement, and a shear code that is the slide, part pose and shear over images, too.",
    base=replace(
        parted.sweep.base,
        name="parted_images",
        unshear=replace(standard.experiment.unshear, pose_channels=16, shear_channels=2, apart=True),
        pins=PinNet(),
        train=replace(standard.experiment.train, epochs=4, agreement_weight=0.05, slide_weight=1.0),
        train_pins=Training(),
        train_posenet=standard.experiment.train_posenet,
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
    ablation=True,
)
