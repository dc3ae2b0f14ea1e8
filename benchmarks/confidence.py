"""How well `image.understood` distinguishes a sensor's images from others, and where its weights come from.

groups = [simulated(TACTIP_331, Camera(), 200, seed=0), recorded(folder, 200, seed=0)]
base, weights = calibrate([observe(group, seed=0) for group in groups])
rows = measure([observe(group, seed=1) for group in others])  # shares refused of each set, accepted of each kind; AUC
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from benchmarks.strangers import OTHER_PINS, STRANGERS, touched, varied
from jaxunshear.dataset.recordings import read_image, read_recordings
from jaxunshear.image.fitting import fit_lattice, layout_of
from jaxunshear.image.framing import undeformed
from jaxunshear.image.pins import find_pins
from jaxunshear.image.preprocess import prepare_frame
from jaxunshear.image.understood import ALLOWED, ENOUGH, Expected, Seen, differences, expected_of, score, seen_of
from jaxunshear.progress import Progress
from jaxunshear.settings.image import Camera, Preprocess
from jaxunshear.settings.sensor import TACTIP_127, TACTIP_331, Sensor
from jaxunshear.storage import Json

SIZE = 128
COUNT = 100  # images of a group
LATTICE_FROM = 60  # recorded images, at most, which are not judged
STRICT = 3e-4  # of the penalty on weights, without which kinds that differ at a glance make them endless
SURE = 1.96  # standard deviations: intervals of 95 %


def bench(folders: Sequence[Path], seed: int) -> list[Json]:
    """Rows of `measure` for simulated sensors and for recordings in `folders`. Raises UserError."""
    groups = [simulated(sensor, Camera(), COUNT, seed) for sensor in (TACTIP_331, TACTIP_127)]
    groups += [recorded(folder, COUNT, seed) for folder in folders]
    with Progress("strangers", len(groups), unit="groups") as progress:
        observed = []
        for group in groups:
            observed.append(observe(group, seed))
            progress.advance()
    return measure(observed)


class Group(NamedTuple):
    """Images (N, S, S) of one sensor, half of them as on another day, and what a model of it expects."""

    name: str
    images: np.ndarray
    expected: Expected


def simulated(sensor: Sensor, camera: Camera, count: int, seed: int) -> Group:
    """Of the simulator's pins, moved by smooth fields."""
    images = touched(sensor, camera, count, seed, SIZE)
    place = undeformed(sensor, camera, Preprocess(size=SIZE)).place
    return Group(f"simulated, {sensor.name}", _half_varied(images, seed), expected_of(place, SIZE))


def recorded(folder: Path, count: int, seed: int) -> Group:
    """Of recordings of 331 pins; what is expected comes from others of the same folder."""
    recordings = read_recordings(folder, Preprocess(size=SIZE))
    view = recordings.common_view()
    rows = np.random.default_rng(seed).permutation(len(recordings))[: count + LATTICE_FROM]
    images = np.array([prepare_frame(recordings.preprocess, read_image(recordings.files[row]), view) for row in rows])
    first = min(LATTICE_FROM, len(images) // 2)
    pins = [find_pins(image) for image in images[:first]]
    expected = expected_of(fit_lattice(pins, layout_of(TACTIP_331)).place, SIZE)
    images = _half_varied(images[first : first + count], seed)
    return Group(f"recorded, {'/'.join(folder.parts[-3:])}", images, expected)


def _half_varied(images: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([varied(image, rng) if row % 2 else image for row, image in enumerate(images)])


class Observed(NamedTuple):
    """What is seen in a group's images, and in those of strangers."""

    name: str
    expected: Expected
    known: list[Seen]
    strange: dict[str, list[Seen]]  # by kind


def observe(group: Group, seed: int, each: int = 20) -> Observed:
    """Of `each` strangers of every kind, made of the group's first images or of sensors with other pins."""
    rng = np.random.default_rng([seed, 1])
    made = {kind: [seen_of(make(image, rng)) for image in group.images[:each]] for kind, make in STRANGERS.items()}
    others = {kind: sensor for kind, sensor in OTHER_PINS.items() if sensor.pins != group.expected.pins}
    made |= {kind: list(map(seen_of, touched(sensor, Camera(), each, seed, SIZE))) for kind, sensor in others.items()}
    return Observed(group.name, group.expected, list(map(seen_of, group.images)), made)


def calibrate(observed: list[Observed]) -> tuple[float, dict[str, float]]:
    """Base and weights of `understood.plausibility`: a logistic of the squared differences, known images and strangers counting alike.

    Images without a lattice are left out: they are refused whatever the weights.
    """
    known = np.concatenate([_squares(each.known, each.expected) for each in observed])
    strange = np.concatenate([_squares(seen, each.expected) for each in observed for seen in each.strange.values()])
    squares = np.concatenate([known, strange])
    target = np.repeat([1.0, -1.0], [len(known), len(strange)])
    share = np.repeat([0.5 / len(known), 0.5 / len(strange)], [len(known), len(strange)])

    def loss(values: np.ndarray) -> float:
        margin = target * (values[0] - squares @ values[1:])
        return float(share @ np.logaddexp(0, -margin) + STRICT * np.sum(values**2))

    start = np.array([4.0] + [1.0] * len(ALLOWED))
    found = minimize(loss, start, bounds=[(0, None)] * len(start)).x
    return float(found[0]), dict(zip(ALLOWED, map(float, found[1:]), strict=True))


def _squares(seen: list[Seen], expected: Expected) -> np.ndarray:
    """(N', features) of those that show a lattice at all."""
    off = [differences(each, expected) for each in seen if each.spacing]
    return np.array([[each[name] / ALLOWED[name] for name in ALLOWED] for each in off]).reshape(-1, len(ALLOWED)) ** 2


def measure(observed: list[Observed]) -> list[Json]:
    """Rows of each group, then of each kind of stranger over all groups, then of all."""
    known = [_scores(each.known, each.expected) for each in observed]
    rows = [_row(each.name, "refused", scores < ENOUGH) for each, scores in zip(observed, known, strict=True)]
    own = np.concatenate(known)
    rows.append(_row("all known", "refused", own < ENOUGH))
    kinds: dict[str, list[np.ndarray]] = {}
    for each in observed:
        for kind, seen in each.strange.items():
            kinds.setdefault(kind, []).append(_scores(seen, each.expected))
    strange = {kind: np.concatenate(scores) for kind, scores in kinds.items()}
    for kind, scores in (strange | {"all strangers": np.concatenate(list(strange.values()))}).items():
        rows.append(_row(kind, "accepted", scores >= ENOUGH) | {"auc": auc(own, scores)})
    return rows


def _scores(seen: list[Seen], expected: Expected) -> np.ndarray:
    return np.array([score(each, expected) for each in seen])


def _row(name: str, what: str, wrong: np.ndarray) -> Json:
    low, high = wilson(int(np.sum(wrong)), len(wrong))
    return {"name": name, "images": len(wrong), what: float(np.mean(wrong)), "low": low, "high": high}


def auc(known: np.ndarray, strange: np.ndarray) -> float:
    """How often a known image (N,) is more plausible than a strange one (M,); alike counts half."""
    order = np.sort(strange)
    below, upto = (np.searchsorted(order, known, side) for side in ("left", "right"))
    return float(np.mean(below + upto) / (2 * len(strange)))


def wilson(wrong: int, count: int) -> tuple[float, float]:
    """An interval of 95 % of a share (Wilson 1927)."""
    z2 = SURE**2
    middle = (wrong + z2 / 2) / (count + z2)
    half = SURE / (count + z2) * (wrong * (count - wrong) / count + z2 / 4) ** 0.5
    return max(middle - half, 0.0), min(middle + half, 1.0)
