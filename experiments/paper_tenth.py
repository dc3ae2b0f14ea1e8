"""Claim: trained as appendix B says, the disentangled network is better than the entangled one with
a tenth of the paper's taps and slides, too.

    # three seeds; and one seed, as a run
    jaxunshear sweep experiments/paper_tenth.py --seeds 0,1,2
    jaxunshear run experiments/paper_tenth.py

Appendix B is read as in experiments/paper.py. At 256 px, of the sensor, camera and friction that
were fitted to recordings: 200 poses of each of three shapes with 5 taps and 15 slides, and the
paper's epochs with its drops of the learning rate.

Expected, docs/results/paper_tenth.json: MS-SSIM 0.935 against taps of the slide's own depth,
entangled 0.927 (sheared 0.59, best translation 0.81); 0.89 against taps that miss that depth by up
to 1 mm, as the paper pairs them. With three seeds at a time on one H200, the disentangled network
took 3.3 to 3.4 minutes, the entangled one 2.7 to 2.8, PoseNet 1.3.
"""

from dataclasses import replace

import paper

from jaxunshear.config.configs import PAIRED, POSE, get_config_sensor

experiment = replace(
    paper.experiment,
    name="paper_tenth",
    claim="The paper's training, on a tenth of its taps and slides.",
    sensor=get_config_sensor("paper_tenth"),
    paired=PAIRED["paper_tenth"],
    pose=POSE["paper_tenth"],
    train=replace(
        paper.experiment.train,
        validate_every=845,  # five epochs
        validation_images=10_000,  # the entire split
    ),
)
