"""Errors over the number of contacts, at a small size."""

from dataclasses import replace

import pytest

from benchmarks import bench_contacts
from jaxunshear.errors import UserError
from jaxunshear.fit import BASE_EXPERIMENT
from tests.recordings import made

TARGETS = ("y_mm", "z_mm", "Rz_deg")


@pytest.fixture
def small(monkeypatch):
    """Sizes and trainings of a test."""
    pins = replace(BASE_EXPERIMENT.pins, conv_channels=(), hidden=32)
    training = replace(BASE_EXPERIMENT.train_pins, epochs=2, min_steps=1)
    base = replace(BASE_EXPERIMENT, pins=pins, train_pins=training)
    monkeypatch.setattr(bench_contacts, "BASE_EXPERIMENT", base)
    monkeypatch.setattr(bench_contacts, "SIZES", (40, 60, 1000))
    monkeypatch.setattr(bench_contacts, "TEST", 20)


def test_each_size_that_the_recordings_allow_has_its_rows(small, tmp_path):
    folder = made.edge(tmp_path / "edge", 90, 80)
    rows = bench_contacts.bench_contacts(folder)
    kinds = bench_contacts.KINDS
    assert [row["name"] for row in rows] == [
        f"{size}/{kind}" for size in (40, 60) for kind in kinds
    ]
    for row in rows:
        assert set(row) == {"name", "contacts", "train_s", *TARGETS}
        assert all(row[name] > 0 for name in TARGETS)
    assert "Rz_deg" in bench_contacts.format_table(rows)


def test_test_contacts_are_in_no_training(small, tmp_path):
    contacts = bench_contacts._shuffle(made.edge(tmp_path / "edge", 60, 60), seed=3)
    parts = [dict(contacts.take(rows)) for rows in (slice(20), slice(20, 60))]
    for kind in ("tap", "shear"):
        test, train = (set(part[kind].files) for part in parts)
        assert len(test) == 20 and len(train) == 40 and not test & train


@pytest.mark.parametrize("contacts", [None, 59])
def test_recordings_that_are_missing_or_too_few_are_refused(small, tmp_path, contacts):
    folder = contacts and made.edge(tmp_path / "edge", contacts, 60)
    with pytest.raises(UserError, match="--recordings = "):
        bench_contacts.bench_contacts(folder)
