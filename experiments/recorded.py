"""Claim: a sensor's own recordings are enough to take the slide out of its touch.

    jaxunshear run experiments/recorded.py --recordings DIR                          # images
    jaxunshear run experiments/recorded.py --recordings DIR --unshear.input pins     # pins: more exact, in minutes

DIR holds taps and slides with their labels, in one of the layouts of docs/your-own-recordings.md. Taps alone train a PoseNet; slides
alone train one that reads slides; both together are unsheared.

Expected on two cores, of 5,000 taps and 5,000 slides of an edge (three seeds; docs/results/recorded_pins.json, recorded_images.json): over
pins eight minutes, tap, unsheared and directly learnt y .12, .16 and .16 mm; over images 20 minutes, .19, .28 and .31 mm.

A surface instead of an edge is a matter of the targets:

    jaxunshear run experiments/recorded.py --recordings DIR --targets z_mm,Rx_deg,Ry_deg --name surface
"""

from jaxunshear.fit import BASE

experiment = BASE
