"""Draws contacts of recordings, and trains networks over pins on them as `fit` does."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import list_trained_networks
from jaxunshear.config.serialization import load_settings
from jaxunshear.data.recorded_contacts import RecordedContacts, read_test_contacts
from jaxunshear.data.recordings import read_image
from jaxunshear.demo_data import Labels, write_recording
from jaxunshear.errors import UserError
from jaxunshear.evaluation.recorded_evaluation import score_recordings
from jaxunshear.files import Json
from jaxunshear.fit import BASE_EXPERIMENT, set_recordings
from jaxunshear.results.run import Results
from jaxunshear.run import run_stages
from jaxunshear.text_table import format_text_table

TEST = 500  # taps, and as many slides, of other contacts


class DrawnContacts(NamedTuple):
    """Taps and slides, in an order of chance."""

    taps: RecordedContacts
    slides: RecordedContacts

    def take(self, rows: slice) -> Iterator[tuple[str, RecordedContacts]]:
        for name, contacts in zip(("tap", "shear"), self, strict=True):
            yield name, contacts.take(np.arange(len(contacts.files))[rows])

    def count_fewer(self) -> int:
        """Count the taps or the slides, whichever are fewer."""
        return min(len(each.files) for each in self)


def draw_contacts(recordings: Path | None, least: int, seed: int) -> DrawnContacts:
    """Draw taps and slides of recordings. Raises UserError if there are fewer than `least`."""
    if recordings is None:
        raise UserError("--recordings = none: must be a folder of taps and slides; name it")
    folder = str(recordings)
    contacts = read_test_contacts(Recorded(tap_folder=folder, slide_folder=folder))
    generator = np.random.default_rng(seed)
    rows = [np.flatnonzero(contacts.is_slide == is_slide) for is_slide in (False, True)]
    drawn = DrawnContacts(*(contacts.take(generator.permutation(each)) for each in rows))
    if drawn.count_fewer() < least:
        raise UserError(
            f"--recordings = {recordings}: must hold {least} taps and as many slides, "
            f"not {drawn.count_fewer()}; name a larger set"
        )
    return drawn


def write_contacts(
    folder: Path,
    contacts: DrawnContacts,
    rows: slice,
    change: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> None:
    """Write taps and slides into `folder`, their images changed by `change`."""
    for name, selected in contacts.take(rows):
        labels = Labels(selected.pose, selected.move)
        images = (change(read_image(file)) for file in selected.files)
        write_recording(folder / name, images, labels, selected.pose_id)


def train(place: Path, recordings: str, seed: int, *more: str) -> Path:
    """Train on place/recordings, do `more` stages, and return the run."""
    experiment = make_experiment(place / recordings, seed)
    networks = list_trained_networks(experiment)
    run_stages(experiment, ("data", *networks, *more), place / "runs", place / "datasets", "")
    return place / "runs" / experiment.name


def make_experiment(recordings: Path, seed: int) -> Experiment:
    """Make the experiment of `fit` over pins."""
    unshear = replace(BASE_EXPERIMENT.unshear, input="pins")
    experiment = replace(BASE_EXPERIMENT, name=recordings.name, seed=seed, unshear=unshear)
    return set_recordings(experiment, str(recordings), str(recordings))


def score(place: Path, run: Path, recordings: str) -> Results:
    """Score a run on place/recordings."""
    experiment = load_settings(run)
    return score_recordings(experiment, run, place / recordings, place / "datasets", "")


def format_rows(rows: list[Json]) -> str:
    """Format rows as text, with a column for each label that varies."""
    return format_text_table(rows, columns=tuple(rows[0]))
