"""Measures errors over the number of taps and slides that a network over pins learns from.

A row is a training with the settings of `fit` on that many taps and as many slides, drawn from
recordings, a fifth of which it keeps for validation and test as usual. Errors are of other contacts
of the recordings, the same ones in all rows of a seed.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import list_trained_networks
from jaxunshear.data.recorded_contacts import RecordedContacts, read_test_contacts
from jaxunshear.data.recordings import read_image
from jaxunshear.demo_data import Labels, write_recording
from jaxunshear.errors import UserError
from jaxunshear.evaluation.recorded_evaluation import score_recordings
from jaxunshear.files import Json
from jaxunshear.fit import BASE_EXPERIMENT, set_recordings
from jaxunshear.results.record_files import read_times
from jaxunshear.results.run import Results
from jaxunshear.run import run_stages
from jaxunshear.text_table import format_text_table

SIZES = (100, 300, 1000, 3000)  # taps, and as many slides
TEST = 500  # taps, and as many slides, of other contacts
KINDS = ("tap", "sheared", "unsheared", "sheared_learnt")


def format_table(rows: list[Json]) -> str:
    """Format rows as text; the columns are those of the labels that vary."""
    return format_text_table(rows, columns=tuple(rows[0]))


class _Contacts(NamedTuple):
    """Taps and slides, in an order of chance."""

    taps: RecordedContacts
    slides: RecordedContacts

    def take(self, rows: slice) -> Iterator[tuple[str, RecordedContacts]]:
        for name, contacts in zip(("tap", "shear"), self, strict=True):
            yield name, contacts.take(np.arange(len(contacts.files))[rows])


def bench_contacts(recordings: Path | None = None, seed: int = 0) -> list[Json]:
    """Return a row for each number of contacts and kind of estimate: errors in mm and deg.

    `seed` draws contacts and weights. Raises UserError if recordings hold too few contacts.
    """
    if recordings is None:
        raise UserError("--recordings = none: must be a folder of taps and slides; name it")
    contacts = _shuffle(recordings, seed)
    fewest = min(len(each.files) for each in contacts)
    if fewest < TEST + SIZES[0]:
        raise UserError(
            f"--recordings = {recordings}: must hold {TEST + SIZES[0]} taps and as many slides, "
            f"not {fewest}; name a larger set"
        )
    rows: list[Json] = []
    with TemporaryDirectory() as name:
        place = Path(name)
        _write(place / "test", contacts, slice(TEST))
        for size in SIZES:
            if fewest < TEST + size:
                break
            _write(place / f"recordings_{size}", contacts, slice(TEST, TEST + size))
            results, train_s = _train(place, size, seed)
            for kind in KINDS:
                row = {"name": f"{size}/{kind}", "contacts": size, "train_s": train_s}
                rows.append(row | dict(results.pose_mae[kind]))
    return rows


def _shuffle(recordings: Path, seed: int) -> _Contacts:
    folder = str(recordings)
    contacts = read_test_contacts(Recorded(tap_folder=folder, slide_folder=folder))
    generator = np.random.default_rng(seed)
    rows = [np.flatnonzero(contacts.is_slide == is_slide) for is_slide in (False, True)]
    return _Contacts(*(contacts.take(generator.permutation(each)) for each in rows))


def _write(folder: Path, contacts: _Contacts, rows: slice) -> None:
    for name, selected in contacts.take(rows):
        labels = Labels(selected.pose, selected.move)
        write_recording(folder / name, map(read_image, selected.files), labels, selected.pose_id)


def _train(place: Path, size: int, seed: int) -> tuple[Results, float]:
    """Train on contacts of a size; return errors on the test contacts, and the time in seconds."""
    experiment = set_recordings(
        _make_experiment(size, seed), *2 * (str(place / f"recordings_{size}"),)
    )
    networks = list_trained_networks(experiment)
    run_stages(experiment, ("data", *networks), place, place / "datasets", "")
    run = place / experiment.name
    train_s = sum(read_times(run).values())
    return score_recordings(experiment, run, place / "test", place / "datasets", ""), train_s


def _make_experiment(size: int, seed: int) -> Experiment:
    unshear = replace(BASE_EXPERIMENT.unshear, input="pins")
    return replace(BASE_EXPERIMENT, name=f"contacts_{size}", seed=seed, unshear=unshear)
