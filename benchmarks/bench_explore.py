"""Measures how long a picture of `explore` takes, for random places of the mouse.

    rows = bench_explore()

A picture is a slide and a tap, their images, pins and forces, and the outputs of the networks.
Compilation and the browser are not measured.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from jaxunshear.apps.explore.explorer import MOST_SLIDE_MM, Explorer, Touch, make_explorer
from jaxunshear.config.data import Ranges
from jaxunshear.environment import keep_freed_memory
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.inference.trained_model import load_model
from jaxunshear.progress import Progress
from jaxunshear.simulator.stimuli import get_stimulus
from jaxunshear.text_table import format_text_table

STIMULI = ("disk", "clover", "edge", "surface")
PICTURES = 100  # of each
WITHIN_MM, MAX_YAW_DEG = 5.0, 45.0
COLUMNS = ("name", "pictures", "refused", "ms", "ms_p95", "most_ms")
format_table = partial(format_text_table, columns=COLUMNS)


def bench_explore(
    stimuli: tuple[str, ...] = STIMULI, pictures: int = PICTURES, *, warm: bool = True
) -> list[Json]:
    """Return a row for each stimulus: pictures, refused ones, and ms (median, 95 %, largest)."""
    keep_freed_memory()
    explorer = make_explorer(load_model("standard"))
    for touch in explorer.list_touches() if warm else ():
        explorer.simulate_picture(touch)
    with Progress("bench explore", pictures * len(stimuli), unit="pictures") as progress:
        return [_measure_stimulus(explorer, name, pictures, progress.advance) for name in stimuli]


def _measure_stimulus(
    explorer: Explorer, name: str, pictures: int, advance: Callable[[], object]
) -> Json:
    generator = np.random.default_rng(0)
    times_ms, refused = [], 0
    for _ in range(pictures):
        touch = _sample_touch(explorer, name, generator)
        start = time.perf_counter()
        try:
            explorer.simulate_picture(touch)
        except UserError:
            refused += 1
        else:
            times_ms.append(1e3 * (time.perf_counter() - start))
        advance()
    percentiles = np.percentile(times_ms, (50, 95, 100)).tolist() if times_ms else [None] * 3
    return {
        "name": name,
        "pictures": len(times_ms),
        "refused": refused,
        **dict(zip(("ms", "ms_p95", "most_ms"), percentiles, strict=True)),
    }


def _sample_touch(explorer: Explorer, name: str, generator: np.random.Generator) -> Touch:
    """Sample a slide of up to MOST_SLIDE_MM to a place about the target point."""
    x, y = generator.uniform(-WITHIN_MM, WITHIN_MM, 2)
    ranges = Ranges()
    yaw = generator.uniform(-MAX_YAW_DEG, MAX_YAW_DEG)
    depth = generator.uniform(ranges.depth_min_mm, ranges.depth_max_mm)
    length = generator.uniform(0, MOST_SLIDE_MM)
    direction = generator.uniform(0, 2 * np.pi)
    move = (length * np.cos(direction), length * np.sin(direction))
    stimulus = get_stimulus(name)
    return Touch(stimulus, explorer.model.sensor, (x, y, yaw, depth), move, stimulus.friction)
