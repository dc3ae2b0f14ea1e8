"""Test slides that are transferred from other tasks to taps."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxunshear.data.reader import Reader
from jaxunshear.data.slide_transfer import (
    FACTOR,
    TransferReader,
    give_slides,
    make_slide_transfer,
)
from jaxunshear.errors import UserError

RNG = np.random.default_rng(0)
REST = RNG.uniform(10, 90, (20, 2))
MOTIONS = RNG.normal(0, 1, (4, 20, 2))  # one for each slide of the other task
TAPS = np.float32(REST + RNG.normal(0, 0.1, (300, 20, 2)))


def measure_length(motions):
    return np.linalg.norm(motions, axis=(1, 2))


@pytest.fixture
def transfer():
    taps = REST + RNG.normal(0, 5, (4, 20, 2))  # what was touched does not matter
    rows = {
        "canonical_pins": taps,
        "sheared_pins": taps + MOTIONS,
        "sure": np.array([1, 1, 1, 0]),
    }
    rows["sheared_pins"][2, 5] = np.nan
    return make_slide_transfer([Reader(lambda split: rows, 96)], REST)


def test_each_tap_gets_the_scaled_motion_of_a_slide_whose_pins_are_seen(transfer):
    motion = transfer(TAPS, "train", np.random.default_rng(0)) - TAPS
    projected = np.einsum("npi,mpi->nm", motion, MOTIONS)
    cosine = projected / np.linalg.norm(MOTIONS, axis=(1, 2)) / measure_length(motion)[:, None]
    numbers = cosine.argmax(axis=1)
    np.testing.assert_allclose(cosine.max(axis=1), 1, atol=1e-4)
    assert set(numbers) == {0, 1}
    factor = measure_length(motion) / measure_length(MOTIONS)[numbers]
    assert FACTOR[0] < factor.min() < 0.3 and 2 < factor.max() < FACTOR[1]
    assert np.median(factor) == pytest.approx(np.sqrt(FACTOR[0] * FACTOR[1]), abs=0.15)


def test_the_shape_of_a_placed_object_stays_while_pins_move_past_it():
    rest = np.stack(np.meshgrid(*[np.linspace(10, 90, 9)] * 2), -1).reshape(-1, 2)
    slope, slide = np.array([[0.02, 0.01], [-0.01, 0.03]]), np.array([3.0, -2.0])
    taps = np.float32(np.tile(rest + rest @ slope, (6, 1, 1)))
    taps[:, 40] = np.nan
    rows = {
        "canonical_pins": np.zeros((1, 81, 2)),
        "sheared_pins": np.tile(slide, (1, 81, 1)),
        "sure": np.ones(1),
    }
    move = make_slide_transfer([Reader(lambda split: rows, 96)], rest, is_placed=True)
    pins = move(taps, "train", np.random.default_rng(0))
    inner = (np.abs(rest - 50) < 28).all(axis=1) & (np.abs(rest - 50) > 12).any(axis=1)
    near = (np.abs(rest - 50) < 12).all(axis=1) & (np.abs(rest - 50) > 1).any(axis=1)
    assert np.isfinite(pins[:, near]).all()  # although a pin between them is lost
    motion = pins[:, inner] - rest[inner] - rest[inner] @ slope
    factor = motion[:, :1, 0] / (slide + slide @ slope)[0]
    expected = factor[:, :, None] * (slide + slide @ slope)
    np.testing.assert_allclose(motion, np.broadcast_to(expected, motion.shape), atol=1e-3)
    assert np.isnan(pins[:, 40]).all() and np.isfinite(pins[:, inner]).all()


def test_a_split_has_the_same_slides_each_time(transfer):
    stored = SimpleNamespace(read_labelled_taps=lambda split: {"pins": TAPS})
    first, again, other = (
        give_slides(stored, transfer, split) for split in ("train", "train", "validation")
    )
    np.testing.assert_array_equal(first["sheared_pins"], again["sheared_pins"])
    assert (first["sheared_pins"] != other["sheared_pins"]).any()
    assert first["row"].tolist() == list(range(300)) and np.isnan(first["move"]).all()


def test_slides_that_lack_pins_cannot_be_transferred():
    rows = {name: np.full((2, 20, 2), np.nan) for name in ("canonical_pins", "sheared_pins")}
    transfer = make_slide_transfer([Reader(lambda split: rows | {"sure": np.ones(2)}, 96)], REST)
    with pytest.raises(UserError, match="no train slide of the other tasks shows all pins"):
        transfer(TAPS, "train", np.random.default_rng(0))


def test_a_batch_has_new_slides_of_the_task_without_any(transfer):
    count = len(TAPS)
    rows = {
        "canonical_pins": TAPS,
        "sheared_pins": TAPS + 1,
        "stimulus": np.arange(count, dtype=np.int32) % 2,
        "pose_id": np.arange(count, dtype=np.int32),
    }
    batches = TransferReader(lambda split: rows, 96, {1: transfer}).train_batches(64, 0, 0.0)
    stream = batches(0)
    first, second = next(stream), next(stream)
    is_given = first["stimulus"] == 1
    recorded = first["sheared_pins"][~is_given] - first["canonical_pins"][~is_given]
    np.testing.assert_allclose(recorded, 1, atol=1e-5)
    given = first["sheared_pins"][is_given] - first["canonical_pins"][is_given]
    assert (np.abs(given - 1).max(axis=(1, 2)) > 0.05).all()
    np.testing.assert_array_equal(next(batches(1))["sheared_pins"], second["sheared_pins"])
    later = next(batches(10))  # has some of the first taps
    _, one, other = np.intersect1d(
        first["pose_id"][is_given], later["pose_id"][later["stimulus"] == 1], return_indices=True
    )
    again = later["sheared_pins"][later["stimulus"] == 1][other]
    assert len(one) and (again != first["sheared_pins"][is_given][one]).any(axis=(1, 2)).all()
    np.testing.assert_array_equal(rows["sheared_pins"], TAPS + 1)
