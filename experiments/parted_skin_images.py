"""Claim: codes over images of a real sensor are disentangled by the same means as over pins.

    jaxunshear sweep experiments/parted_skin_images.py --recordings DIR

The recorded slides are those of parted_skin.py, as images. The pose code of a slide agrees with
that of its tap, in every direction of the code over its variance. The shear code has an encoder of
its own, and learns the two shifts of the slide as they are labelled.

Expected: docs/results/parted_skin_images.json; 20 minutes per row on a core.
"""

from dataclasses import replace

from jaxunshear.config.sweep import Sweep
from jaxunshear.fit import BASE_EXPERIMENT

CODES = ("unshear.apart", "unshear.pose_channels", "unshear.shear_channels")
ROWS = {
    "as recorded.py trains": (),
    "disentangled": (
        (CODES, (True, 8, 2)),
        (("train.losses.code_agreement", "train.losses.slide"), (2.0, 1.0)),
    ),
}

sweep = Sweep(
    name="parted_skin_images",
    claim="Codes over images of a real sensor are disentangled.",
    base=replace(BASE_EXPERIMENT, name="parted_skin_images"),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    networks=("disentangled", "posenet"),
    seeds=(0, 1, 2),
    ablation=True,
)
