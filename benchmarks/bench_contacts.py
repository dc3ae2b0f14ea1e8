"""Measures errors over the number of taps and slides that a network over pins learns from.

A row is a training with the settings of `fit` on that many taps and as many slides, drawn from
recordings, a fifth of which it keeps for validation and test as usual. Errors are of other contacts
of the recordings, the same ones in all rows of a seed.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.drawn_contacts import (
    TEST,
    draw_contacts,
    format_rows,
    score,
    train,
    write_contacts,
)
from jaxunshear.files import Json
from jaxunshear.results.record_files import read_times

SIZES = (100, 300, 1000, 3000)  # taps, and as many slides
KINDS = ("tap", "sheared", "unsheared", "sheared_learnt")
format_table = format_rows


def bench_contacts(recordings: Path | None = None, seed: int = 0) -> list[Json]:
    """Return a row for each number of contacts and kind of estimate: errors in mm and deg.

    `seed` draws contacts and weights. Raises UserError if recordings hold too few contacts.
    """
    contacts = draw_contacts(recordings, TEST + SIZES[0], seed)
    rows: list[Json] = []
    with TemporaryDirectory() as name:
        place = Path(name)
        write_contacts(place / "test", contacts, slice(TEST))
        for size in SIZES:
            if contacts.count_fewer() < TEST + size:
                break
            learnt = f"contacts_{size}"
            write_contacts(place / learnt, contacts, slice(TEST, TEST + size))
            run = train(place, learnt, seed)
            errors = score(place, run, "test").pose_mae
            train_s = sum(read_times(run).values())
            for kind in KINDS:
                row = {"name": f"{size}/{kind}", "contacts": size, "train_s": train_s}
                rows.append(row | dict(errors[kind]))
    return rows
