"""Claim: it compares like with like, over recorded pins: networks that unshear slides, and those
that learn their poses directly.

    jaxunshear sweep experiments/rivals.py --recordings DIR

Each row trains a network that unshears and a PoseNet that learns poses of slides directly, of equal
encoders, on the same contacts. One PoseNet of taps reads all unsheared slides of a seed. It learns
from recorded and rendered taps, and it is dense in every row.

What differs between rows:

* dense: both encoders have dense layers alone.
* convolving: both convolve over the same grid across the pins, with as many channels.
* direct from rendered taps, too: half of the examples of the direct PoseNet are taps that the
  renderer draws. The taps then teach it, as they teach unshearing.
* no pose labels in the loss: the loss of the network that unshears has no pose in it. Labels still
  say where the renderer draws the tap of each slide.

Rows share the trainings that are equal. Checkpoints are chosen by the loss on validation contacts.
One row by itself, of seed 0 (`--seed 1` for another):

    jaxunshear run experiments/recorded.py --recordings DIR --unshear.input pins --name ROW OPTIONS

OPTIONS are the first four of these lines, the fifth or sixth, and the seventh or eighth if the
name of the row says so:

    all rows                    --train_pins.optimiser adam --train_pins.learning_rate 3e-3
    and                         --train_pins.epochs 100 --train_pins.validate_every 500
    and                         --train_pins.min_steps 1 --train_pins.losses.pose_label 1
    and                         --train_pins.rotated_below 0
    dense                       --pins.conv_channels=
    convolving                  --pins.direct_conv_channels 24,48,96
    direct from rendered taps   --paired.direct_taps rendered
    no pose labels              --train_pins.losses.pose_label 0

`jaxunshear evaluate runs/ROW --recordings OTHER` scores it on other recordings; a row's folder in
`runs/sweeps/rivals/rows` is a run, too.

Expected: docs/results/rivals.json, discussed in docs/unshear-or-directly.md. Five rows of three
seeds took two hours on a core of an AMD EPYC, beside other work.
"""

from dataclasses import replace

from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinNet
from jaxunshear.config.sweep import Sweep
from jaxunshear.fit import BASE_EXPERIMENT

CHANNELS = BASE_EXPERIMENT.pins.conv_channels
CONVOLVING = (("pins.conv_channels", "pins.direct_conv_channels"), (CHANNELS, CHANNELS))
RENDERED = ("paired.direct_taps", "rendered")
ROWS = {
    "dense": (),
    "dense, direct from rendered taps, too": (RENDERED,),
    "convolving": (CONVOLVING,),
    "convolving, direct from rendered taps, too": (CONVOLVING, RENDERED),
    "convolving, no pose labels in the loss": (CONVOLVING, ("train_pins.losses.pose_label", 0.0)),
}

sweep = Sweep(
    name="rivals",
    claim="Unsheared and directly learnt poses of slides, by networks of the same make.",
    base=replace(
        BASE_EXPERIMENT,
        name="rivals",
        unshear=replace(BASE_EXPERIMENT.unshear, input="pins"),
        pins=PinNet(),
        train_pins=PIN_TRAINING,
    ),
    rows=tuple(ROWS.values()),
    labels=tuple(ROWS),
    seeds=(0, 1, 2),
)
