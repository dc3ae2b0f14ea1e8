"""Simulate new contacts of an experiment's stimuli, which no network was trained on.

So anybody who has only the weights can score them, too, without the data sets of the training.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.splits import BLOCK
from jaxunshear.data.chunks import render_images
from jaxunshear.data.sampling import sample_pairs
from jaxunshear.simulator.contacts import compute_indentation
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.simulate import follow

SCALE_TAPS = 300  # simulated taps that scales are fitted to
SEED = 1_000_003  # added to the data's


class SimulatedContacts(NamedTuple):
    """N slides, each with the tap at its pose, less the contacts that did not converge."""

    stimulus: np.ndarray  # (N,) index into the experiment's
    pose: np.ndarray  # (N, 4) x, y mm, yaw deg, depth mm
    tap: np.ndarray  # (N, S, S) uint8 of {0, 255}
    sheared: np.ndarray  # (N, S, S)
    tap_pins: np.ndarray  # (N, P, 2) px
    sheared_pins: np.ndarray  # (N, P, 2)
    indentation_mm: np.ndarray  # (N, P) of the tap
    dropped: int


def simulate_contacts(
    experiment: Experiment, count: int, seed: int = 0, depth_mm: float | None = None
) -> SimulatedContacts:
    """Simulate slides at new poses, as many of each stimulus, and the tap at each pose.

    There are `count` of them, rounded up to the same number for each stimulus, and at least 5 per
    stimulus (a block of the split); less those that did not converge. `depth_mm` sets one depth for
    all, else depths are the experiment's. The same seed gives the same contacts.
    """
    paired = experiment.paired.get_simulated("this")
    poses = max(BLOCK, -(-count // len(paired.stimuli)))
    new = paired.seed + SEED + seed
    settings = replace(paired, poses=poses, taps=1, slides=1, tap_depth_jitter_mm=0.0, seed=new)
    if depth_mm is not None:
        ranges = replace(settings.ranges, depth_min_mm=depth_mm, depth_max_mm=depth_mm)
        settings = replace(settings, ranges=ranges)
    samples = sample_pairs(settings)
    contacts, skins = follow(experiment.sensor, paired.stimuli, make_paths(samples.scenes))
    # Both are in the same order, as there are one tap and one slide at a pose.
    slides, taps = np.flatnonzero(samples.is_slide), np.flatnonzero(~samples.is_slide)
    converged = contacts.converged[slides] & contacts.converged[taps]
    slides, taps = slides[converged], taps[converged]
    rows = np.concatenate([taps, slides])
    images, pins = render_images(
        settings, experiment.sensor, contacts.pins[rows], rows, samples.age[rows]
    )
    half = len(slides)
    return SimulatedContacts(
        stimulus=samples.scenes.stimulus[slides],
        pose=samples.scenes.pose[slides],
        tap=images[:half],
        sheared=images[half:],
        tap_pins=pins[:half],
        sheared_pins=pins[half:],
        indentation_mm=compute_indentation(experiment.sensor, skins.take(taps)),
        dropped=int(np.sum(~converged)),
    )


def render_untouched_images(experiment: Experiment, count: int) -> np.ndarray:
    """Render images (N, S, S) uint8 of {0, 255} of the sensor that touches nothing.

    Their light, noise and wear are those of other images.
    """
    paired = experiment.paired.get_simulated("this")
    tips = np.repeat(compute_pin_tips(experiment.sensor)[None], count, axis=0)
    numbers, ages = SEED + np.arange(count), np.linspace(0, 1, count)
    images, _ = render_images(paired, experiment.sensor, tips, numbers, ages)
    return images
