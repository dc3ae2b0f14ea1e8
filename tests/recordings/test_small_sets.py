"""Pairs of small recordings are turned about the sensor's axis, fewer the more there are."""

from dataclasses import replace

import pytest

from jaxunshear.config.serialization import load_settings
from jaxunshear.training import task_factory
from jaxunshear.training.examples import open_examples


@pytest.mark.parametrize(("limit", "share"), [(0, None), (1, None), (1.25, 0.1), (4, 0.375)])
def test_sets_below_the_limit_are_rotated(pins_run, place, monkeypatch, limit, share):
    experiment = load_settings(pins_run)
    examples = open_examples(experiment, "disentangled", place / "datasets", pins_run)
    rotated_below = round(limit * examples.reader.length("train"))
    training = replace(experiment.train_pins, rotated_below=rotated_below)
    experiment = replace(experiment, train_pins=training)
    shares = []

    def make_pair_rotation(rest, share):
        shares.append(share)
        return lambda batch, key: (batch, False)

    monkeypatch.setattr(task_factory, "make_pair_rotation", make_pair_rotation)
    task_factory.make_task(experiment, "disentangled", examples, pins_run)
    assert shares == ([] if share is None else [pytest.approx(share, abs=5e-3)])
