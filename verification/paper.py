"""Random scenes of the paper's distribution (its section 3.2) over all seven shapes."""

import numpy as np

from jaxunshear.config.data import Ranges
from jaxunshear.simulator.scene import Scenes, make_scenes, sample_poses, sample_slides
from jaxunshear.simulator.stimuli import SHAPES as NAMES

KINDS = ("slide", "tap")


def sample_paper_scenes(kind: str, count: int, seed: int = 0) -> Scenes:
    """Sample `count` slides, or taps at the same poses, each shape in turn.

    The first of many are the same as few.
    """
    ranges = Ranges()
    single = []
    for number in range(count):
        generator = np.random.default_rng((seed, number))
        depth = (ranges.depth_min_mm, ranges.depth_max_mm)
        pose = sample_poses(generator, 1, ranges.lateral_mm, ranges.yaw_deg, depth)
        single.append(np.concatenate([pose, sample_slides(generator, 1, ranges.move_mm)], axis=1))
    motions = np.concatenate(single) if single else np.zeros((0, 6))
    pose, move = motions[:, :4], motions[:, 4:] * (kind == "slide")
    return make_scenes(NAMES, np.arange(count) % len(NAMES), pose, move)
