"""How well `image.understood` tells a sensor's images from others, and where its weights come from.

    calibrate([simulated(sensor, camera, 200, seed=0) ..., recorded(folder, 200, seed=0) ...])   # base and weights
    measure([...])   # rows: of each set the share of images refused, of each kind of stranger the share accepted and the AUC
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from jaxunshear.checks.strangers import OTHER_PINS, STRANGERS, touched, varied
from jaxunshear.dataset.recordings import read_image, read_recordings
from jaxunshear.image.fitting import fit_lattice, layout_of
from jaxunshear.image.framing import undeformed
from jaxunshear.image.pins import find_pins
from jaxunshear.image.preprocess import prepare_frame
from jaxunshear.image.settings import Camera, Preprocess
from jaxunshear.image.understood import ALLOWED, ENOUGH, Expected, differences, expected_of, score, seen_of
from jaxunshear.scene.sensor import TACTIP_331, Sensor

SIZE = 128
LATTICE_FROM = 60  # recorded images, that are not judged
STRICT = 1e-3  # of the penalty on weights, without which kinds that are told apart at a glance make them endless
SURE = 1.96  # standard deviations: intervals of 95 %


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


def recorded(folder: Path, count: int, seed: int, expected: Expected | None = None) -> Group:
    """Of recordings of 331 pins; what is expected comes from others of the same folder where it is not given."""
    recordings = read_recordings(folder, Preprocess(size=SIZE))
    view = recordings.common_view()
    order = np.random.default_rng(seed).permutation(len(recordings))
    rows = order[: count + LATTICE_FROM] if expected is None else order[:count]
    images = np.array([prepare_frame(recordings.preprocess, read_image(recordings.files[row]), view) for row in rows])
    if expected is None:
        first = max(LATTICE_FROM - max(count + LATTICE_FROM - len(images), 0), 10)
        pins = [find_pins(image) for image in images[:first]]
        expected, images = expected_of(fit_lattice(pins, layout_of(TACTIP_331)).place, SIZE), images[first:]
    return Group(f"recorded, {folder.name}", _half_varied(images, seed), expected)


def _half_varied(images: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([varied(image, rng) if row % 2 else image for row, image in enumerate(images)])


def strangers_of(group: Group, seed: int) -> dict[str, np.ndarray]:
    """As many images of each kind that are not the group's sensor's."""
    rng = np.random.default_rng([seed, 1])
    made = {kind: np.array([make(image, rng) for image in group.images]) for kind, make in STRANGERS.items()}
    others = {kind: sensor for kind, sensor in OTHER_PINS.items() if sensor.pins != group.expected.pins}
    if group.expected.pins != TACTIP_331.pins:
        others["331 pins"] = TACTIP_331
    return made | {kind: touched(sensor, Camera(), len(group.images), seed, SIZE) for kind, sensor in others.items()}


def calibrate(groups: list[Group], seed: int = 0) -> tuple[float, dict[str, float]]:
    """Base and weights of `understood.plausibility`: a logistic of the squared differences, known images and strangers counting alike.

    Images without a lattice are left out: they are refused whatever the weights.
    """
    known = np.concatenate([_squares(group.images, group.expected) for group in groups])
    strange = np.concatenate(
        [_squares(images, group.expected) for group in groups for images in strangers_of(group, seed).values()]
    )
    squares = np.concatenate([known, strange])
    target = np.repeat([1.0, -1.0], [len(known), len(strange)])
    share = np.repeat([0.5 / len(known), 0.5 / len(strange)], [len(known), len(strange)])

    def loss(values: np.ndarray) -> float:
        margin = target * (values[0] - squares @ values[1:])
        return float(share @ np.logaddexp(0, -margin) + STRICT * np.sum(values**2))

    start = np.array([4.0] + [1.0] * len(ALLOWED))
    found = minimize(loss, start, bounds=[(0, None)] * len(start)).x
    return float(found[0]), dict(zip(ALLOWED, map(float, found[1:]), strict=True))


def _squares(images: np.ndarray, expected: Expected) -> np.ndarray:
    """(N', features) of those images (N, S, S) that show a lattice at all."""
    seen = [each for each in map(seen_of, images) if each.spacing]
    off = np.array([[differences(each, expected)[name] / ALLOWED[name] for name in ALLOWED] for each in seen])
    return off.reshape(-1, len(ALLOWED)) ** 2


def measure(groups: list[Group], seed: int = 1) -> list[dict[str, Any]]:
    """Rows of each group, then of each kind of stranger over all groups, then of all."""
    known = [_scores(group.images, group.expected) for group in groups]
    rows = [_row(group.name, "refused", scores < ENOUGH) for group, scores in zip(groups, known, strict=True)]
    kinds: dict[str, list[np.ndarray]] = {}
    for group in groups:
        for kind, images in strangers_of(group, seed).items():
            kinds.setdefault(kind, []).append(_scores(images, group.expected))
    own = np.concatenate(known)
    strange = {kind: np.concatenate(scores) for kind, scores in kinds.items()}
    rows.append(_row("all known", "refused", own < ENOUGH))
    for kind, scores in (strange | {"all strangers": np.concatenate(list(strange.values()))}).items():
        rows.append(_row(kind, "accepted", scores >= ENOUGH) | {"auc": auc(own, scores)})
    return rows


def _scores(images: np.ndarray, expected: Expected) -> np.ndarray:
    return np.array([score(seen_of(image), expected) for image in images])


def _row(name: str, what: str, wrong: np.ndarray) -> dict[str, Any]:
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
