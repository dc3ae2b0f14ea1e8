"""Networks that learnt in simulation, scored on recordings of an edge: from simulation to skin.

>>> results = score_transfer(experiment, Path("weights"), Path("recordings"), command)
>>> results.pose_mae["unsheared"]["Rz_deg"]

What they read, edge distance, edge direction and depth, has its own zero and sense. Half of the recorded taps, drawn at random, show how
it goes with the labels: a sign and an offset each. The other half is scored, and every slide; no reading is fitted to slides.
Unsheared pins are read with a zero of their own, that of unsheared taps: the network moves real taps a little, and all of them alike.
With the zero of taps as recorded, unsheared slides are scored once more (`UNSHEARED_RAW_OFFSET`).
For networks over pins, where pins rest is the mean over some of the contacts themselves: of taps for taps, of slides for slides.

Networks over pins are also read by one of another make: a kernel ridge that learns pose from the pins of those same taps. It has nothing
in common with the networks, and with the simulator that they learnt in.
"""

import time
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, require_simulated, uses_pins
from jaxunshear.config.targets import (
    MIN_VARIATION,
    RECORDED_FIELDS,
    Target,
    list_target_names,
    make_label_targets,
)
from jaxunshear.data.digests import compute_digest
from jaxunshear.data.preprocessing import MIN_FRAMES, find_sensor_frame
from jaxunshear.data.recorded_contacts import (
    RecordedContacts,
    find_common_view,
    read_test_contacts,
)
from jaxunshear.data.recordings import read_image
from jaxunshear.errors import UserError
from jaxunshear.evaluation.measurements import round_values
from jaxunshear.evaluation.pose_estimators import (
    PIN_PLACES,
    RidgeEstimator,
    compute_pin_features,
    estimate_poses,
    fit_to_features,
)
from jaxunshear.inference.perceiver import AS_RECORDED, UNSHEARED, Perceiver, load_perceiver
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.metrics.pose_error import compute_pose_errors
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.progress import Progress
from jaxunshear.results.run import Counts, Results
from jaxunshear.results.training_summaries import read_training_facts

BATCH = 32
SEED = 0  # of the taps that show how readings and labels go together
UNSHEARED_RAW_OFFSET = (
    "unsheared_raw_zero"  # unsheared slides, read with the zero of taps as recorded
)
LABEL_TARGETS = {
    "x_mm": "edge_mm",
    "y_mm": "edge_mm",
    "z_mm": "depth_mm",
    "Rz_deg": "edge_deg",
}  # what goes with a label


class LabelAlignment(NamedTuple):
    """label = sign * reading + offset."""

    target: str
    sign: int
    offset: float

    def __call__(self, poses: dict[str, np.ndarray]) -> np.ndarray:
        return self.sign * poses[self.target] + self.offset


def score_transfer(
    experiment: Experiment,
    model: Path,
    recordings: Path,
    command: str,
    network: Perceiver | None = None,
) -> Results:
    """Results in the names of results.json, of the networks at `model` or of `network`. Raises UserError where the recordings hold no
    labelled taps and slides of one edge."""
    started = time.perf_counter()
    paired, _ = require_simulated(experiment, "this")
    settings = Recorded(
        str(recordings),
        str(recordings),
        compute_digest((str(recordings),)),
        preprocess=paired.preprocess,
    )
    contacts = read_test_contacts(settings)
    contacts = contacts.take(np.flatnonzero(np.isfinite(contacts.pose).all(axis=1)))
    taps, slides = (
        contacts.take(np.flatnonzero(contacts.is_slide == slid)) for slid in (False, True)
    )
    for kind, found in (("taps", taps), ("slides", slides)):
        if len(found.files) < MIN_FRAMES:
            raise UserError(
                f"{recordings} holds {len(found.files)} labelled {kind}: at least {MIN_FRAMES} are needed to score by"
            )
    known_half = np.random.default_rng(SEED).random(len(taps.files)) < 0.5
    (of_taps, tap_pins), (of_slides, slide_pins) = (
        _read(experiment, model, network, settings, *kind)
        for kind in ((taps, "taps"), (slides, "slides"))
    )
    if UNSHEARED not in of_slides:
        raise UserError(f"{model} holds no network that unshears and PoseNet beside it: train both")
    names = choose_scored_labels(
        _select_rows(of_taps[AS_RECORDED], known_half), taps.pose[known_half]
    )
    mae = _score_ways(names, known_half, (of_taps, taps.pose), (of_slides, slides.pose))
    tap_read, slide_read = (
        np.isfinite(next(iter(of[AS_RECORDED].values()))) for of in (of_taps, of_slides)
    )
    results = Results(
        experiment=experiment.name,
        trained_in=model.name,
        metric={
            "pose_mae": "mean absolute error of a PoseNet that learnt from simulated taps, sign and offset of each reading by half of the "
            f"recorded taps, which are unsheared where slides are; {UNSHEARED_RAW_OFFSET}: by these taps as recorded",
            "pose_recovery": "(sheared - unsheared) / (sheared - tap)",
            "readers": "mean absolute error of a kernel ridge that learnt from the pins of half of the recorded taps",
        },
        settings=asdict(experiment),
        pin_error={},
        test_data="other recordings",
        targets=tuple(Target(name, *RECORDED_FIELDS[name]) for name in names),
        pose_mae=mae,
        pose_recovery={"unsheared": _recovery(mae)},
        readers=_score_reader(names, known_half, (taps.pose, tap_pins), (slides.pose, slide_pins)),
        counts=_count(known_half, tap_read, slide_read),
        time_s={"evaluate": time.perf_counter() - started},
        **read_training_facts(model, experiment.networks),
        **describe_provenance(command),
    )
    return round_values(results)


def _score_ways(
    names: tuple[str, ...],
    known_half: np.ndarray,
    taps: tuple[dict[str, dict[str, np.ndarray]], np.ndarray],
    slides: tuple[dict[str, dict[str, np.ndarray]], np.ndarray],
) -> dict[str, dict[str, float]]:
    """Return mean absolute errors by way and label, of readings with their labels (N, 6).

    Sign and offset come from the known half of the taps.
    """
    (of_taps, tap_labels), (of_slides, slide_labels) = taps, slides
    raw, after = (
        {
            name: align_to_labels(
                name, _select_rows(of_taps[way], known_half), tap_labels[known_half]
            )
            for name in names
        }
        for way in (AS_RECORDED, UNSHEARED)
    )
    return {
        "tap": _errors(
            raw, _select_rows(of_taps[AS_RECORDED], ~known_half), tap_labels[~known_half]
        ),
        "sheared": _errors(raw, of_slides[AS_RECORDED], slide_labels),
        "unsheared": _errors(after, of_slides[UNSHEARED], slide_labels),
        UNSHEARED_RAW_OFFSET: _errors(raw, of_slides[UNSHEARED], slide_labels),
    }


def _count(known_half: np.ndarray, tap_read: np.ndarray, slide_read: np.ndarray) -> Counts:
    return Counts(
        known_taps=int((known_half & tap_read).sum()),
        test_taps=int((~known_half & tap_read).sum()),
        test_poses=int(slide_read.sum()),
        unread_taps=int((~tap_read).sum()),
        test_unsure=int((~slide_read).sum()),
    )


def _score_reader(
    names: tuple[str, ...],
    known: np.ndarray,
    taps: tuple[np.ndarray, dict[str, np.ndarray]],
    slides: tuple[np.ndarray, dict[str, np.ndarray]],
) -> dict[str, dict[str, dict[str, float]]]:
    """Errors by way of a reader that learns from the taps `known` (T,); of taps and slides labels (N, 6) and pins by way
    (N, P, 2) px. Empty where there are no pins, or too few taps to learn from."""
    (tap_pose, tap_pins), (slide_pose, slide_pins) = taps, slides
    if not tap_pins:
        return {}
    sure = known & np.isfinite(tap_pins[AS_RECORDED]).all(axis=(1, 2))
    targets = make_label_targets(names, tap_pose[sure])
    reader = fit_to_features(
        compute_pin_features(tap_pins[AS_RECORDED][sure]), {"pose": tap_pose[sure]}, targets
    )
    seen = {
        "tap": (tap_pins[AS_RECORDED][~known], tap_pose[~known]),
        "sheared": (slide_pins[AS_RECORDED], slide_pose),
        "unsheared": (slide_pins[UNSHEARED], slide_pose),
    }
    if not reader:
        return {}
    return {
        PIN_PLACES: {
            way: _compute_estimator_errors(reader, pins, labels)
            for way, (pins, labels) in seen.items()
        }
    }


def choose_scored_labels(readings: dict[str, np.ndarray], labels: np.ndarray) -> tuple[str, ...]:
    """The labels (N, 6) that vary and that something was read for. Raises UserError where both x and y vary: an edge leaves one open."""
    columns = {name: labels[:, column] for name, (_, column) in RECORDED_FIELDS.items()}
    names = tuple(
        n
        for n, reads in LABEL_TARGETS.items()
        if reads in readings and np.ptp(columns[n]) > MIN_VARIATION
    )
    if not names or {"x_mm", "y_mm"} <= set(names):
        raise UserError(
            "these labels are not of a straight edge, across which x or y varies: only such can be scored"
        )
    return names


def align_to_labels(
    name: str, readings: dict[str, np.ndarray], labels: np.ndarray
) -> LabelAlignment:
    """By the taps (N,) that could be read: the sign with the least scatter, and the median offset, of an angle the mean direction."""
    reads, column = LABEL_TARGETS[name], RECORDED_FIELDS[name][1]
    read, label = readings[reads], labels[:, column]
    fine = np.isfinite(read)
    if not fine.any():
        raise UserError("no tap could be read: these are not images of the model's sensor")
    found = []
    for sign in (1, -1):
        rest = label[fine] - sign * read[fine]
        if name.endswith("_deg"):
            mean = np.mean(np.exp(1j * np.radians(rest)))
            found.append(
                (1 - abs(mean), LabelAlignment(reads, sign, float(np.degrees(np.angle(mean)))))
            )
        else:
            found.append((float(np.std(rest)), LabelAlignment(reads, sign, float(np.median(rest)))))
    return min(found, key=lambda each: each[0])[1]


def _read(
    experiment: Experiment,
    model: Path,
    network: Perceiver | None,
    settings: Recorded,
    contacts: RecordedContacts,
    kind: str,
) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, np.ndarray]]:
    """Poses by way and quantity, (N,) each, and pins by way, (N, P, 2) px, of networks over pins; NaN where a contact could not be
    read."""
    contacts = contacts._replace(
        split=np.zeros(len(contacts.files), int)
    )  # all alike: whoever seeks training frames finds them
    if network is None:
        frame = (
            find_sensor_frame(contacts, settings, experiment.sensor)
            if uses_pins(experiment)
            else None
        )
        network = load_perceiver(model, experiment, True, frame)
    view = network.view or find_common_view(contacts, network.preprocess)
    found: dict[str, dict[str, np.ndarray]] = {}
    pins: dict[str, np.ndarray] = {}
    size = network.preprocess.size
    with Progress(f"read {kind}", len(contacts.files), "frames") as progress:
        for start in range(0, len(contacts.files), BATCH):
            files = contacts.files[start : start + BATCH]
            images = np.zeros((BATCH, size, size), np.uint8)
            for i, file in enumerate(files):
                try:
                    images[i] = prepare_frame(network.preprocess, read_image(file), view)
                except UserError:
                    continue  # left black, which is not understood
            answers = network.predict(images)
            for way, poses in answers.poses.items():
                for name, values in poses.items():
                    full = found.setdefault(way, {}).setdefault(
                        name, np.full(len(contacts.files), np.nan)
                    )
                    full[start : start + len(files)] = values[: len(files)]
            for way, there in answers.pins.items():
                full = pins.setdefault(
                    way, np.full((len(contacts.files), *there.shape[1:]), np.nan)
                )
                full[start : start + len(files)] = there[: len(files)]
            progress.advance(len(files))
    if not found:
        raise UserError(
            f"{model} holds no trained PoseNet: what it reads off recordings is what is scored"
        )
    return found, pins


def _select_rows(poses: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[rows] for name, values in poses.items()}


def _errors(
    aligned: dict[str, LabelAlignment], poses: dict[str, np.ndarray], labels: np.ndarray
) -> dict[str, float]:
    fine = np.isfinite(next(iter(poses.values())))
    if not fine.any():
        return dict.fromkeys(aligned, float("nan"))
    return _mean_errors(
        {name: each(_select_rows(poses, fine)) for name, each in aligned.items()}, labels[fine]
    )


def _compute_estimator_errors(
    reader: RidgeEstimator, pins: np.ndarray, labels: np.ndarray
) -> dict[str, float]:
    """Of the contacts whose pins (N, P, 2) px are known."""
    sure = np.isfinite(pins).all(axis=(1, 2))
    if not sure.any():
        return dict.fromkeys(list_target_names(reader.targets), float("nan"))
    return _mean_errors(estimate_poses(reader, compute_pin_features(pins[sure])), labels[sure])


def _mean_errors(found: dict[str, np.ndarray], labels: np.ndarray) -> dict[str, float]:
    true = {name: labels[:, RECORDED_FIELDS[name][1]] for name in found}
    return {name: float(error.mean()) for name, error in compute_pose_errors(found, true).items()}


def _recovery(mae: dict[str, dict[str, float]]) -> dict[str, float | None]:
    """None where a slide spoils nothing."""
    lost = {name: mae["sheared"][name] - mae["tap"][name] for name in mae["tap"]}
    return {
        n: (mae["sheared"][n] - mae["unsheared"][n]) / by if by > 0 else None
        for n, by in lost.items()
    }
