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

RNG = np.random.default_rng(0)
REST = RNG.uniform(10, 90, (20, 2))
MOTIONS = RNG.normal(0, 1, (4, 20, 2))  # one for each slide of the other task
TAPS = np.float32(REST + RNG.normal(0, 0.1, (300, 20, 2)))


def measure_factors(slides, taps, numbers):
    """Measure by how much motions were scaled, and check that nothing else was done to them."""
    motion, original = slides - taps, MOTIONS[numbers]
    factor = np.sum(motion * original, (1, 2)) / np.sum(original**2, (1, 2))
    np.testing.assert_allclose(motion, factor[:, None, None] * original, atol=1e-4)
    return factor


@pytest.fixture
def transfer():
    taps = REST + RNG.normal(0, 5, (4, 20, 2))  # what was touched does not matter
    rows = {
        "canonical_pins": taps,
        "sheared_pins": taps + MOTIONS,
        "move": np.arange(24.0).reshape(4, 6),
        "sure": np.array([1, 1, 1, 0]),
    }
    rows["sheared_pins"][2, 5] = np.nan
    return make_slide_transfer([Reader(lambda split: rows, 96)], REST)


def test_each_tap_gets_the_scaled_motion_of_a_slide_whose_pins_are_seen(transfer):
    pins, moves = transfer(TAPS, "train", np.random.default_rng(0))
    numbers = (moves[:, 0] / 6).astype(int)
    assert set(numbers) == {0, 1}
    factor = measure_factors(pins, TAPS, numbers)
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
        "move": np.zeros((1, 6)),
        "sure": np.ones(1),
    }
    move = make_slide_transfer([Reader(lambda split: rows, 96)], rest, is_placed=True)
    pins = move(taps, "train", np.random.default_rng(0)).pins
    inner = (np.abs(rest - 50) < 28).all(axis=1) & (np.abs(rest - 50) > 12).any(axis=1)
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
    assert first["row"].tolist() == list(range(300))


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
    np.testing.assert_array_equal(rows["sheared_pins"], TAPS + 1)
