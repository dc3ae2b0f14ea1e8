"""Claim: over images of real skin the codes part by the same means as over pins.

    jaxunshear sweep experiments/parted_skin_images.py --recordings DIR

The recorded slides of parted_skin.py, as images: of parted_images.py there is left that the pose code of a slide agrees with that of its
tap, and that the shear code is the slide as it is labelled, two shifts and three turns, and has an encoder of its own.

Expected: docs/results/parted_skin_images.json; 20 minutes a row on a core.
"""

from dataclasses import replace

from jaxunshear.fit import BASE
from jaxunshear.settings.sweep import Sweep

sweep = Sweep(
    name="parted_skin_images",
    claim="Over images of real skin the codes part by the same means as over pins.",
    base=replace(BASE, name="parted_skin_images"),
    rows=(
        (),
        (
            (("unshear.apart", "unshear.pose_channels", "unshear.shear_channels"), (True, 16, 5)),
            (("train.agreement_weight", "train.slide_weight"), (0.05, 1.0)),
        ),
    ),
    labels=("as recorded.py trains", "parted"),
    networks=("disentangled", "posenet"),
    seeds=(0, 1, 2),
    ablation=True,
)
