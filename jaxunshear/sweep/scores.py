"""Scores of a cell's rows, one for each seed: by test and name, with the poses and the shapes of their contacts."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.stimuli import list_stimulus_names
from jaxunshear.errors import UserError
from jaxunshear.evaluation.bootstrap import number_poses
from jaxunshear.evaluation.unambiguous_edges import SMOOTH
from jaxunshear.files import BROKEN_NPZ, explain_os_error, read_npz
from jaxunshear.results.run import Notes
from jaxunshear.results.sweep import Outcome

SCORES = "scores.npz"  # of an evaluation, beside scores-<test>.npz

# of the paired data: names, how contacts appear, what is made of recorded ones
NON_CONTACT_SETTINGS = (
    *("config", "camera", "nuisance", "preprocess"),
    *("pairing", "pairs", "labelled", "direct_taps", "tap_folder", "slide_folder"),
)


class RowScores(NamedTuple):
    """A row that has ended: its outcome, and the scores of every test contact where it did not fail.

    `tests` is by test, "" for the main one: arrays (N,) by the names of the scores, which have a slash; `stimulus` and `pose_id`.
    """

    outcome: Outcome
    tests: Mapping[str, Mapping[str, np.ndarray]]


def read_tests(folder: Path, remedy: str) -> dict[str, dict[str, np.ndarray]]:
    """The scores that an evaluation left in `folder`, by test. Raises UserError."""
    paths = [folder / SCORES, *sorted(folder.glob("scores-*.npz"))]
    return {
        path.stem.removeprefix("scores").removeprefix("-"): _read(path, remedy) for path in paths
    }


def _read(path: Path, remedy: str) -> dict[str, np.ndarray]:
    try:
        return read_npz(path)
    except OSError as error:
        raise explain_os_error(path, error, "read") from error
    except BROKEN_NPZ as error:
        raise UserError(f"{path} is damaged ({error}): {remedy}") from error


def list_score_names(rows: Mapping[int, RowScores]) -> list[tuple[str, str]]:
    """Tests and names of their scores, those that every row has: one measured by an earlier version may lack some."""
    first, *others = [row.tests for row in rows.values()] or [{}]
    return [
        (test, name)
        for test, scores in first.items()
        for name in scores
        if "/" in name and all(name in tests.get(test, {}) for tests in others)
    ]


def get_metric_notes(rows: Mapping[int, RowScores]) -> Notes:
    """What exactly the evaluation calls MS-SSIM, and other such notes."""
    return next(iter(rows.values())).outcome.evaluated_results.metric if rows else {}


def format_name(test: str, name: str, shape: str = "") -> str:
    """`<test>, <shape>: <name>`, without what is empty."""
    of = ", ".join(filter(None, (test, shape)))
    return f"{of}: {name}" if of else name


def stack_seeds(rows: Mapping[int, RowScores], test: str, name: str) -> np.ndarray:
    """(seeds, N)"""
    return np.stack([np.asarray(row.tests[test][name], np.float64) for row in rows.values()])


def select_by_shape(rows: Mapping[int, RowScores], test: str) -> dict[str, np.ndarray]:
    """Which contacts (N,) of a test are with which shape."""
    results = next(iter(rows.values())).outcome.evaluated_results
    stimuli = results.settings["paired"].get("stimuli", ())  # of recordings none is known
    if test:
        stimuli = results.tests[test].stimuli if test in results.tests else ()
    names, stimulus = list_stimulus_names(stimuli), _labels(rows, test)["stimulus"]
    return {
        name: stimulus == index for index, name in enumerate(names) if np.any(stimulus == index)
    }


def select_smooth(rows: Mapping[int, RowScores], test: str) -> dict[str, np.ndarray]:
    """Say which contacts (N,) of a test have a nearest edge of one direction, if there are such.

    Scores of an earlier version do not say so.
    """
    smooth = _labels(rows, test).get(SMOOTH)
    return {SMOOTH: smooth.astype(bool)} if smooth is not None and smooth.any() else {}


def has_same_contacts(
    rows: Mapping[int, RowScores], other: Mapping[int, RowScores], test: str
) -> bool:
    """Whether both were drawn from the same settings, and none was lost that the other has."""
    if _drawn_from(rows, test) != _drawn_from(other, test):
        return False
    one, two = _labels(rows, test), _labels(other, test)
    return all(np.array_equal(one[name], two[name]) for name in ("stimulus", "pose_id"))


def _drawn_from(rows: Mapping[int, RowScores], test: str) -> dict[str, object]:
    """The settings that decide the contacts of a test."""
    results = next(iter(rows.values())).outcome.evaluated_results
    settings, own = results.settings, results.tests.get(test)
    paired = {
        name: value if (drawn := getattr(own, name, None)) is None else drawn
        for name, value in settings["paired"].items()
        if name not in NON_CONTACT_SETTINGS
    }
    return paired | {"sensor": settings["sensor"]}


def number_contact_poses(rows: Mapping[int, RowScores], test: str) -> np.ndarray:
    """(N,) which pose of which stimulus a contact belongs to."""
    labels = _labels(rows, test)
    return number_poses(labels["stimulus"], labels["pose_id"])


def _labels(rows: Mapping[int, RowScores], test: str) -> Mapping[str, np.ndarray]:
    """Those of a test's contacts, which all seeds share."""
    return next(iter(rows.values())).tests[test]
