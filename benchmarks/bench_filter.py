"""Measures what `stream --filter` gains, and how far it lags, on simulated walks.

The sensor weaves over a straight edge, and its contact keeps its history from frame to frame. The
weights `standard` unshear each frame and read the edge off it. There is a row without a filter and
one for each DRIFT of its model, times the one in use.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from jaxunshear.apps.robot.pose_filter import FilterState, find_noise, update_filter
from jaxunshear.config.networks import DISENTANGLED
from jaxunshear.data.simulation import render_images
from jaxunshear.files import Json
from jaxunshear.inference.edge_methods import make_edge_estimators
from jaxunshear.inference.trained_model import TrainedModel, load_model
from jaxunshear.progress import Progress
from jaxunshear.simulator.contacts import Skins
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.scene import make_edge_labeler
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import make_stimulus
from jaxunshear.text_table import format_text_table

STIMULUS = "edge"
FRAMES_PER_S = 30
FRAMES = 120  # of a walk
WALKS = 6
PERIODS_S = {"slow": 4.0, "fast": 1.0}  # of the weaving, of half of the walks each
SPEED_MM_S = 10.0  # along the edge
REACH = {"edge_mm": 2.5, "edge_deg": 15.0}  # of the weaving to either side
DEPTH_MM = 3.0
DRIFT_FACTORS = (0.3, 1.0, 3.0)
MAX_LAG_S = 0.3
SETTLED = 15  # frames after which the start no longer shows
NAMES = tuple(REACH)
COLUMNS = ("name", "drift", *(f"{name}_{what}" for name in NAMES for what in ("rms", "lag_ms")))
format_table = partial(format_text_table, columns=COLUMNS)


class _Walks(NamedTuple):
    period_s: np.ndarray  # (W,)
    true: np.ndarray  # (W, T, 2) edge_mm, edge_deg
    perceived: np.ndarray  # (W, T, 2)


def bench_filter() -> list[Json]:
    """Return a row for each speed of weaving and each filter."""
    walks = _simulate_walks(load_model("standard"))
    rows: list[Json] = []
    for speed, period_s in PERIODS_S.items():
        own = walks.period_s == period_s
        true, perceived = walks.true[own], walks.perceived[own]
        rows.append({"name": f"{speed}, none", "drift": None} | _score(true, perceived))
        for factor in DRIFT_FACTORS:
            filtered = np.stack([_filter(walk, factor) for walk in perceived])
            rows.append({"name": f"{speed}, {factor:g}", "drift": factor} | _score(true, filtered))
    return rows


def _simulate_walks(model: TrainedModel) -> _Walks:
    settings = model.require_simulation("the benchmark of the filter")
    estimate = make_edge_estimators(model, (DISENTANGLED,))[DISENTANGLED]
    assert estimate is not None
    friction = np.full(WALKS, make_stimulus(STIMULUS).friction)
    period_s = np.resize(list(PERIODS_S.values()), WALKS)
    points = _weave(period_s)
    skins, perceived = None, np.zeros((WALKS, FRAMES, 2))
    with Progress("bench filter", FRAMES, "frames") as progress:
        for frame in range(FRAMES):
            paths = Paths(np.zeros(WALKS, int), friction, points[:, frame : frame + 2])
            start = None if skins is None else Skins(skins.force_n, points[:, frame])
            contacts, skins = follow(model.sensor, (STIMULUS,), paths, start=start)
            numbers = frame * WALKS + np.arange(WALKS)  # each frame has noise of its own
            images = render_images(
                settings, model.sensor, contacts.pins, numbers, np.zeros(WALKS), WALKS
            )[0]
            perceived[:, frame] = np.stack(estimate(images), -1)
            progress.advance()
    label = make_edge_labeler(make_stimulus(STIMULUS))
    true = np.stack([label(points[:, frame + 1, :3]) for frame in range(FRAMES)], axis=1)
    return _Walks(period_s, true, perceived)


def _weave(period_s: np.ndarray) -> np.ndarray:
    """Make way points (W, T + 1, 6): the first is above the second, which touches."""
    rng = np.random.default_rng(0)
    time_s = np.arange(FRAMES) / FRAMES_PER_S
    angle = 2 * np.pi * (time_s / period_s[:, None] + rng.random((len(period_s), 1)))
    points = np.zeros((len(period_s), FRAMES + 1, 6))
    points[:, 1:, 0] = REACH["edge_mm"] * np.sin(angle)
    points[:, 1:, 1] = SPEED_MM_S * time_s
    points[:, 1:, 2] = REACH["edge_deg"] * np.sin(angle + 1)
    points[:, 0] = points[:, 1]
    points[:, 1:, 3] = DEPTH_MM
    return points


def _filter(perceived: np.ndarray, factor: float) -> np.ndarray:
    """Filter a walk (T, 2) with `factor` times the drift in use."""
    # only the ratio of drift and noise counts for how it smooths
    noise = {name: value / factor for name, value in find_noise(NAMES, {}).items()}
    filtered = []
    state: FilterState | None = None
    for frame, pose in enumerate(perceived.tolist()):
        state = update_filter(
            state, frame / FRAMES_PER_S, dict(zip(NAMES, pose, strict=True)), noise
        )
        filtered.append([state.pose[name] for name in NAMES])
    return np.array(filtered)


def _score(true: np.ndarray, given: np.ndarray) -> Json:
    """Return the error, rms, and the lag of walks (W, T, 2)."""
    true, given = true[:, SETTLED:], given[:, SETTLED:]
    scores: Json = {}
    for column, name in enumerate(NAMES):
        error = given[..., column] - true[..., column]
        scores[f"{name}_rms"] = round(float(np.sqrt(np.mean(error**2))), 3)
        scores[f"{name}_lag_ms"] = _find_lag_ms(true[..., column], given[..., column])
    return scores


def _find_lag_ms(true: np.ndarray, given: np.ndarray) -> float:
    """Find the delay of the truth (W, T) that is nearest to what is given."""
    time_s = np.arange(true.shape[1]) / FRAMES_PER_S
    inside = slice(round(MAX_LAG_S * FRAMES_PER_S), None)  # a delay needs what came before
    delays = np.arange(-50, 1000 * MAX_LAG_S, 2.0)
    errors = []
    for delay in delays:
        late = np.stack([np.interp(time_s - delay / 1000, time_s, walk) for walk in true])
        errors.append(np.var((given - late)[:, inside]))
    return float(delays[int(np.argmin(errors))])
