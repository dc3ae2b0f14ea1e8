"""Claim: it shows what the shear code does for unsheared images, and what one more convolution
does.

    jaxunshear sweep experiments/ablations/shear_code.py

Before DC, the disentangled network has a 3x3 convolution for its pose code, which the entangled one
lacks. So the two differ in more than the shear code. "No shear code" is the control: it keeps that
convolution, and has neither shear code nor DS. "L_rec at full weight" is the paper's loss;
standard.py uses .3 of it. Everything else is as in standard.py, its data sets too.

Compare rows by `disentangled`. `difference/entangled` in a row is that row less the entangled
network.

Expected: docs/results/shear_code.json. Without a shear code MS-SSIM is a little higher and poses
are as exact; with L_rec at full weight MS-SSIM is a little lower. Per seed four networks are
trained: three that unshear with codes, and an entangled one; a PoseNet, which all rows share, reads
them. A row takes 15 to 25 minutes on a core.
"""

from dataclasses import replace

import standard

from jaxunshear.config.networks import DISENTANGLED, NETWORKS, POSENET
from jaxunshear.config.sweep import Sweep

ROWS = {
    "disentangled": (),
    "no shear code": (("unshear.shear_channels", 0),),
    "L_rec at full weight": (
        ("train.losses.reconstruction", 1.0),
        ("networks", (DISENTANGLED, POSENET)),
    ),
}

sweep = Sweep(
    name="shear_code",
    claim="What a shear code does for unsheared images.",
    base=replace(standard.experiment, networks=NETWORKS),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
)
