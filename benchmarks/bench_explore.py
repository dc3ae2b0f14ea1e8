"""How long a picture of `explore` takes: places of the mouse at random, one after the other, once all is made ready.

    rows = bench_explore()

A picture is a slide and a tap, their images, pins and forces, and what the networks make of them; the browser's own part is left out.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxunshear.allocator import keep_freed_memory
from jaxunshear.apps.explore.explorer import Explorer, make_explorer
from jaxunshear.apps.explore.touch import MOST_SLIDE_MM, Touch
from jaxunshear.config.data import Ranges
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.model_folders import find_model_folder, load_settings
from jaxunshear.progress import Progress
from jaxunshear.simulator.stimuli import get_stimulus

STIMULI = ("disk", "clover", "edge", "surface")
PICTURES = 100  # of each
WITHIN_MM, TURNED_DEG = 5.0, 45.0
COLUMNS = ("name", "pictures", "refused", "ms", "ms_p95", "most_ms")


def bench_explore(
    stimuli: tuple[str, ...] = STIMULI, pictures: int = PICTURES, *, warm: bool = True
) -> list[Json]:
    """A row a stimulus: pictures that came, those refused (with a line), ms a picture: median, 95 % and most."""
    keep_freed_memory()
    folder = find_model_folder(Path("standard"))
    explorer = make_explorer(folder, load_settings(folder))
    if warm:
        explorer.warm()
    with Progress("bench explore", pictures * len(stimuli), unit="pictures") as progress:
        return [_row(explorer, name, pictures, progress.advance) for name in stimuli]


def _row(explorer: Explorer, name: str, pictures: int, advance: Callable[[], object]) -> Json:
    generator = np.random.default_rng(0)
    spent, refused = [], 0
    for _ in range(pictures):
        touch = _sample_touch(explorer, name, generator)
        began = time.perf_counter()
        try:
            explorer.simulate_picture(touch)
        except UserError:
            refused += 1
        else:
            spent.append(1e3 * (time.perf_counter() - began))
        advance()
    median, late, most = (
        np.percentile(spent, (50, 95, 100)).tolist() if spent else (None, None, None)
    )
    return {
        "name": name,
        "pictures": len(spent),
        "refused": refused,
        "ms": median,
        "ms_p95": late,
        "most_ms": most,
    }


def _sample_touch(explorer: Explorer, name: str, generator: np.random.Generator) -> Touch:
    """A slide of up to MOST_SLIDE_MM to a place about the target point, of the depths that data have."""
    x, y = generator.uniform(-WITHIN_MM, WITHIN_MM, 2)
    ranges = Ranges()
    yaw, depth = (
        generator.uniform(-TURNED_DEG, TURNED_DEG),
        generator.uniform(ranges.depth_min_mm, ranges.depth_max_mm),
    )
    far, way = generator.uniform(0, MOST_SLIDE_MM), generator.uniform(0, 2 * np.pi)
    move = (far * np.cos(way), far * np.sin(way))
    stimulus = get_stimulus(name)
    return Touch(stimulus, explorer.experiment.sensor, (x, y, yaw, depth), move, stimulus.friction)
