"""Errors over the number of contacts and of a moved camera, at a small size."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import bench_adapt, bench_contacts, drawn_contacts
from jaxunshear.config.sensor import Preprocess
from jaxunshear.errors import UserError
from jaxunshear.fit import BASE_EXPERIMENT
from tests.recordings import made

TARGETS = ("y_mm", "z_mm", "Rz_deg")


@pytest.fixture
def small(monkeypatch):
    """Sizes and trainings of a test."""
    pins = replace(BASE_EXPERIMENT.pins, conv_channels=(), hidden=32, layers=1)
    training = replace(BASE_EXPERIMENT.train_pins, epochs=2, min_steps=1)
    base = replace(BASE_EXPERIMENT, pins=pins, train_pins=training)
    monkeypatch.setattr(drawn_contacts, "BASE_EXPERIMENT", base)
    for bench in (bench_contacts, bench_adapt):
        monkeypatch.setattr(bench, "TEST", 20)
    monkeypatch.setattr(bench_contacts, "SIZES", (40, 60, 1000))
    monkeypatch.setattr(bench_adapt, "LEARNT", 240)  # so many that there are half-widths
    monkeypatch.setattr(bench_adapt, "TAPS", 24)
    monkeypatch.setattr(bench_adapt, "MOVES", {"1 %": bench_adapt.Move(scale=1.01)})


def test_each_size_that_the_recordings_allow_has_its_rows(small, tmp_path):
    rows = bench_contacts.bench_contacts(made.edge(tmp_path / "edge", 90, 80))
    kinds = bench_contacts.KINDS
    assert [row["name"] for row in rows] == [
        f"{size}/{kind}" for size in (40, 60) for kind in kinds
    ]
    for row in rows:
        assert set(row) == {"name", "contacts", "train_s", *TARGETS}
        assert all(row[name] > 0 for name in TARGETS)
    assert "Rz_deg" in bench_contacts.format_table(rows)


@pytest.mark.long
def test_each_move_has_a_row_as_it_is_and_adapted(small, tmp_path):
    rows = bench_adapt.bench_adapt(made.edge(tmp_path / "edge", 290, 284))
    ways = ("as it is", "adapted")
    assert [row["name"] for row in rows] == ["not moved", *(f"1 %/{way}" for way in ways)]
    for row in rows:
        assert set(row) == {"name", *TARGETS, *(f"held_{name}" for name in TARGETS)}
        assert all(row[name] > 0 and 0 <= row[f"held_{name}"] <= 1 for name in TARGETS)


def test_contacts_of_two_parts_are_different_ones(tmp_path):
    contacts = drawn_contacts.draw_contacts(made.edge(tmp_path / "edge", 60, 60), 60, seed=3)
    parts = [dict(contacts.take(rows)) for rows in (slice(20), slice(20, 60))]
    for kind in ("tap", "shear"):
        test, train = (set(part[kind].files) for part in parts)
        assert len(test) == 20 and len(train) == 40 and not test & train


@pytest.mark.parametrize("contacts", [None, 59])
def test_recordings_that_are_missing_or_too_few_are_refused(tmp_path, contacts):
    folder = contacts and made.edge(tmp_path / "edge", contacts, 60)
    with pytest.raises(UserError, match="--recordings = "):
        drawn_contacts.draw_contacts(folder, 60, seed=0)


def test_images_move_as_said(monkeypatch):
    monkeypatch.setattr(bench_adapt, "Preprocess", lambda: Preprocess(size=41))
    image = np.zeros((41, 41), np.uint8)
    image[20, 30] = 200  # ten px to the right of the middle
    shifted = bench_adapt.move_image(image, bench_adapt.Move((2.0, -3.0)))
    assert shifted[22, 27] == 200 and shifted.sum() == 200
    turned = bench_adapt.move_image(image, bench_adapt.Move(turn_deg=90.0))
    assert {tuple(place) for place in np.argwhere(turned > 100)} <= {(10, 20), (30, 20)}
    larger = bench_adapt.move_image(image, bench_adapt.Move(scale=1.5))
    assert larger[20, 35] == 200
    assert (bench_adapt.move_image(image, bench_adapt.Move()) == image).all()
    large = np.zeros((82, 82), np.uint8)
    large[40:42, 60:62] = 200
    shifted = bench_adapt.move_image(large, bench_adapt.Move((2.0, -3.0)))
    assert (shifted[44:46, 54:56] == 200).all() and shifted.sum() == large.sum()
