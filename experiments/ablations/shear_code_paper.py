"""Claim: it shows what the shear code does in the paper's training, and what one more convolution
does.

    jaxunshear sweep experiments/ablations/shear_code_paper.py

The rows are those of shear_code.py, with data, networks and training of paper_tenth.py, whose L_rec
is at full weight already. From E to DC, the disentangled network has one 3x3 convolution more than
the entangled one; "no shear code" keeps it, and has neither shear code nor DS.

Expected: the figures are still to be measured. Per seed three networks that unshear and a PoseNet
are trained. On one H200, three seeds at a time, paper_tenth.py took 3.3 to 3.4 minutes for the
disentangled network, 2.7 to 2.8 for the entangled one, and 1.3 for PoseNet.
"""

import paper_tenth

from jaxunshear.config.sweep import Sweep

ROWS = {"disentangled": (), "no shear code": (("unshear.shear_channels", 0),)}

sweep = Sweep(
    name="shear_code_paper",
    claim="What a shear code does for unsheared images in the paper's training.",
    base=paper_tenth.experiment,
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
)
