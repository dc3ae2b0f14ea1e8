"""Claim: a sensor's own recordings are enough to remove the slide from its tactile images.

    # over images; and over pins, which is more exact and takes minutes
    jaxunshear run experiments/recorded.py --recordings DIR
    jaxunshear run experiments/recorded.py --recordings DIR --unshear.input pins

DIR holds taps and slides with their labels, in one of the layouts of docs/recording-files.md.
One PoseNet learns from taps alone, another from slides alone; the networks that unshear learn from
both.

Expected of 5,000 taps and 5,000 slides of an edge (three seeds; docs/results/recorded_pins.json,
recorded_images.json): over pins y .12 mm for taps, .15 unsheared and .16 learnt directly; over
images .19, .28 and .31 mm. Over pins a seed took 4 minutes on two idle cores of an AMD EPYC,
with reading and scores, and 7 on one; over images 17 to 20 minutes on one or two.

For a surface instead of an edge, change the targets:

    jaxunshear run experiments/recorded.py --recordings DIR --targets z_mm,Rx_deg,Ry_deg \
        --name surface
"""

from jaxunshear.fit import BASE_EXPERIMENT

experiment = BASE_EXPERIMENT
