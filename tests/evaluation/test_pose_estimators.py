"""Readers of another make: what they learn, from which taps, and what they leave out."""

import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.targets import make_range_targets
from jaxunshear.evaluation.contact_scores import ContactScores
from jaxunshear.evaluation.pose_estimators import (
    MIN_EXAMPLES,
    PIN_PLACES,
    PIXELS,
    compute_pin_features,
    compute_pixel_features,
    estimate_poses,
    fit_estimator,
    fit_ridge,
    score_detected_pins,
)
from jaxunshear.evaluation.result_tables import build_tables
from jaxunshear.evaluation.score import Outputs
from jaxunshear.perception.lattice import make_lattice

SIZE = 128
TARGETS = make_range_targets(("x_mm", "edge_mm", "edge_deg:circle"), Ranges())
X, Y = np.meshgrid(np.arange(24, 108, 8.0), np.arange(24, 108, 8.0))
REST = np.stack([X, Y], axis=-1).reshape(-1, 2)


def poses(count, seed):
    generator = np.random.default_rng(seed)
    pose, edge = generator.uniform(-4, 4, (2, count, 4)).astype(np.float32)
    edge = np.stack([edge[:, 0], generator.uniform(-40, 40, count)], axis=1)
    return pose, edge.astype(np.float32)


def pins_of(pose, edge):
    """(N, P, 2) px: linear in what the targets' outputs are."""
    angle = np.radians(edge[:, 1].astype(np.float64))
    across = pose[:, :1] + np.sin(angle)[:, None] * (REST[:, 1] - 64) / 40
    along = edge[:, :1] + np.cos(angle)[:, None] * (REST[:, 0] - 64) / 40
    return REST + np.stack([across, along], axis=-1)


def drawn(pins):
    """(N, S, S) uint8 dots."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    images = [
        np.hypot(columns[..., None] - each[:, 0], rows[..., None] - each[:, 1]).min(axis=-1) < 2.2
        for each in pins
    ]
    return np.where(images, 255, 0).astype(np.uint8)


class Taps:
    """Stands in for a reader of the pose set; any split but that for training is forbidden."""

    def __init__(self, count):
        pose, edge = poses(count, 0)
        self.rows = {"pose": pose, "edge": edge, "pins": pins_of(pose, edge).astype(np.float32)}

    def length(self, split):
        assert split == "train"
        return len(self.rows["pose"])

    def take(self, split, rows, fields):
        assert split == "train"
        return {name: self.rows[name][rows] for name in fields}


@pytest.fixture(scope="module")
def reader():
    return fit_estimator(PIN_PLACES, Taps(200), TARGETS)


def test_a_linear_pose_is_recovered_exactly(reader):
    pose, edge = poses(50, 1)
    found = reader.estimate(compute_pin_features(pins_of(pose, edge)))
    np.testing.assert_allclose(found["x_mm"], pose[:, 0], atol=1e-3)
    np.testing.assert_allclose(found["edge_mm"], edge[:, 0], atol=1e-3)
    np.testing.assert_allclose(found["edge_deg"], edge[:, 1], atol=0.05)
    assert reader.taps == 200


def test_what_is_not_linear_is_learnt_by_a_gaussian():
    x = np.random.default_rng(0).uniform(-1, 1, (400, 2))
    ridge = fit_ridge(x, np.sin(4 * x))
    assert ridge.model.kernel == "rbf"
    assert np.abs(ridge.predict(0.9 * x) - np.sin(3.6 * x)).max() < 0.02


def test_equal_examples_give_their_mean():
    ridge = fit_ridge(np.ones((20, 3)), np.arange(20.0)[:, None])
    np.testing.assert_allclose(ridge.predict(np.ones((2, 3))), 9.5, rtol=1e-5)


def test_the_same_taps_give_the_same_bits(reader):
    again = fit_estimator(PIN_PLACES, Taps(200), TARGETS)
    np.testing.assert_array_equal(again.ridge.model.dual_coef_, reader.ridge.model.dual_coef_)


def test_of_many_taps_some_are_learnt_from_and_of_too_few_nothing():
    assert fit_estimator(PIN_PLACES, Taps(MIN_EXAMPLES - 1), TARGETS) is None
    assert fit_estimator(PIN_PLACES, Taps(20), ()) is None
    assert fit_estimator(PIN_PLACES, Taps(200), TARGETS, max_taps=30).taps == 30


def test_pins_that_are_not_seen_count_as_they_are_on_average(reader):
    taps = Taps(200)
    taps.rows["pins"][::3, 5] = np.nan
    some = fit_estimator(PIN_PLACES, taps, TARGETS)
    pose, edge = poses(50, 1)
    pins = pins_of(pose, edge)
    pins[:, 7] = np.nan
    found = some.estimate(compute_pin_features(pins))
    assert np.abs(found["x_mm"] - pose[:, 0]).max() < 0.5


def test_pixels_are_means_over_squares():
    images = np.zeros((2, 70, 70, 1), np.uint8)
    images[1, 0, 0] = 255
    found = compute_pixel_features(images)
    assert found.shape == (2, 35 * 35)
    assert found[1, 0] == 0.25 and found.sum() == 0.25
    np.testing.assert_array_equal(compute_pixel_features((images / 255).astype(np.float32)), found)


def test_pixels_give_a_pose():
    taps = Taps(150)
    taps.rows["image"] = drawn(taps.rows["pins"])[..., None]
    reader = fit_estimator(PIXELS, taps, TARGETS)
    pose, edge = poses(20, 1)
    images = drawn(pins_of(pose, edge))[..., None] / 255
    outputs = Outputs({"tap": images, "disentangled": images, "mean_tap": images}, {}, {}, {})
    found = estimate_poses(PIXELS, reader, outputs)
    assert set(found) == {"tap", "disentangled"}  # of baselines nothing is asked
    assert np.abs(found["tap"]["x_mm"] - pose[:, 0]).mean() < 0.4 * np.abs(pose[:, 0]).mean()


def test_found_pins_give_a_pose_and_images_without_are_left_out_and_counted(reader):
    pose, edge = poses(6, 1)
    images = {"tap": drawn(pins_of(pose, edge)), "sheared": drawn(pins_of(pose, edge))}
    images["sheared"][2] = 0
    true = {"x_mm": pose[:, 0], "edge_mm": edge[:, 0], "edge_deg": edge[:, 1]}
    scores = score_detected_pins(reader, make_lattice(REST), images, true)
    assert scores["read/pins/tap/x_mm"].max() < 0.3
    assert np.flatnonzero(np.isnan(scores["read/pins/sheared/edge_mm"])).tolist() == [2]
    found = tabulate(scores)
    assert found.reader_images["pins"] == {
        "tap": {"read": 6, "left_out": 0},
        "sheared": {"read": 5, "left_out": 1},
    }
    error = np.nanmean(scores["read/pins/sheared/edge_mm"])
    assert found.readers["pins"]["sheared"]["edge_mm"] == pytest.approx(error)
    low, high = found.spread.readers["pins"]["sheared"]["edge_mm"]
    assert low <= error <= high
    nothing = {name: np.full(6, np.nan) for name in scores}
    assert tabulate(nothing).readers["pins"]["tap"]["x_mm"] is None


def tabulate(estimates):
    labels = {"stimulus": np.zeros(6, int), "pose_id": np.arange(6)}
    return build_tables(ContactScores({}, labels, np.arange(6), {}, {}, estimates))
