"""Contour following: it keeps its history, continues after a kill, and says how it ended."""

import dataclasses

import numpy as np
import pytest

from jaxunshear.config.data import PairedData
from jaxunshear.config.outlines import trace_outline
from jaxunshear.config.sensor import TACTIP_127, TACTIP_331
from jaxunshear.downstream import servo
from jaxunshear.downstream.contour import trace_contour
from jaxunshear.downstream.servo import (
    CLOSED,
    LATE,
    LOST,
    ServoTask,
    follow_contour,
    load_trajectories,
    sample_start_points,
)
from jaxunshear.downstream.servo_scores import compute_perceived_edge, score_trajectories
from jaxunshear.errors import UserError
from jaxunshear.simulator.stimuli import STIMULI

SETTINGS = PairedData()
LENGTH = trace_contour(STIMULI["disk"]).length
STEPS = 16
TASK = ServoTask("disk", starts=2, depth_mm=2.0, max_outline_lengths=STEPS * 0.5 / LENGTH * 0.999)
METHODS = {"true": None}


def follow(file, task=TASK, methods=METHODS, settings=SETTINGS):
    """Return the trajectories, and the score of the first."""
    trajectories, contour = follow_contour(task, TACTIP_331, settings, methods, file)
    return trajectories, contour, score_trajectories(trajectories, contour, "disk")[0]


def test_a_walk_by_the_true_pose_keeps_to_the_edge_and_its_skin_remembers(tmp_path):
    trajectories, contour, row = follow(tmp_path / "disk.npz")
    assert (trajectories.end == LATE).all() and trajectories.steps == 16
    assert not trajectories.failed_contacts.any()
    assert np.abs(trajectories.true[:, -4:, 0]).max() < 0.3  # mm from the edge
    np.testing.assert_allclose(trajectories.way_mm, 15 * 0.5, atol=1.0)
    # friction drags the skin against the way: along the edge, y of the sensor frame
    dragged = trajectories.force_n.sum(axis=1)
    assert (dragged[:, 1] < -0.1 * dragged[:, 2]).all()
    assert row.name == "disk/true" and row.closed == 0 and row.ends == {"took too long": 2}
    assert row.completed == pytest.approx(7.5 / contour.length, rel=0.15)
    assert len(row.walk_mm) == 2 and min(row.walk_mm) <= row.mean_mm <= max(row.walk_mm)
    edge = contour.points[contour.at(trajectories.arc_mm[0])]
    np.testing.assert_allclose(compute_perceived_edge(trajectories, 0)[-1], edge, atol=0.3)


def test_a_killed_walk_goes_on_and_ends_equal(tmp_path, monkeypatch):
    monkeypatch.setattr(servo, "SAVE_EVERY", 5)
    calls, file = [], tmp_path / "disk.npz"

    def perceive(images):
        """Estimate an edge that depends on the full image."""
        calls.append(1)
        full, half = images.mean(axis=(1, 2)), images[:, :64].mean(axis=(1, 2))
        return full / images.max(), half / images.max()

    def perceive_until_killed(images):
        if len(calls) == 25:
            raise KeyboardInterrupt
        return perceive(images)

    full, *_ = follow(tmp_path / "full.npz", methods={"a": perceive})
    assert len(calls) == full.steps == 16
    with pytest.raises(KeyboardInterrupt):
        follow(file, methods={"a": perceive_until_killed})
    assert load_trajectories(file)[1].steps == 5
    again, *_ = follow(file, methods={"a": perceive})
    assert len(calls) == 25 + 11
    for field in ("point", "perceived", "images", "force_n", "sums", "way_mm", "end"):
        np.testing.assert_array_equal(getattr(again, field), getattr(full, field), err_msg=field)
    with pytest.raises(UserError, match="other settings"):
        follow(file, dataclasses.replace(TASK, depth_mm=3.0), {"a": perceive})
    file.write_bytes(b"torn")
    with pytest.raises(UserError, match="delete it"):
        follow(file, methods={"a": perceive})


def test_a_walk_that_is_misled_is_lost_and_reported(tmp_path):
    # says "go outwards"
    astray = {"astray": lambda images: (np.full(len(images), -5.0), np.zeros(len(images)))}
    trajectories, _, row = follow(tmp_path / "disk.npz", methods=astray)
    assert (trajectories.end == LOST).all() and trajectories.steps < 16
    assert row.ends == {"lost the edge": 2} and row.largest_mm > servo.MAX_EDGE_DISTANCE_MM


def test_a_walk_around_an_outline_of_ones_own_closes_and_is_found_again(tmp_path):
    coin = trace_outline("coin", lambda xy: np.hypot(*xy.T) - 5, within_mm=8)
    task = ServoTask(coin, starts=1, depth_mm=2.0)
    trajectories, contour, row = follow(tmp_path / "coin.npz", task)
    assert load_trajectories(tmp_path / "coin.npz")[0] == task
    assert trajectories.end[0] == CLOSED and trajectories.way_mm[0] >= contour.length
    assert (row.closed, row.completed, row.ends) == (1, 1, {"closed": 1}) and row.mean_mm < 0.5


def test_starts_are_spread_and_the_same_for_a_seed():
    contour = trace_contour(STIMULI["disk"])
    points, again, other = (
        sample_start_points(ServoTask("disk", starts=4, seed=seed), contour) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(points, again)
    assert not np.array_equal(points, other)
    distances = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=-1) + 1e3 * np.eye(4)
    assert distances.min() > 60


def test_walks_of_other_networks_or_another_sensor_are_not_taken_for_these(tmp_path):
    preprocess = dataclasses.replace(SETTINGS.preprocess, size=64)
    smaller = dataclasses.replace(SETTINGS, preprocess=preprocess)

    def attempt(sensor, settings, digest):
        follow_contour(TASK, sensor, settings, METHODS, tmp_path / "disk.npz", {"true": digest})

    for _ in range(2):
        attempt(TACTIP_331, SETTINGS, "a")
    for other in (
        (TACTIP_331, SETTINGS, "b"),
        (TACTIP_127, SETTINGS, "a"),
        (TACTIP_331, smaller, "a"),
    ):
        with pytest.raises(UserError, match="another model or sensor"):
            attempt(*other)


@pytest.mark.parametrize(("setting", "friction"), [(None, STIMULI["disk"].friction), (0.2, 0.2)])
def test_walks_touch_with_the_friction_of_the_data(setting, friction):
    """Check Coulomb's law: slipping skin pulls by friction times pressure, and no skin more."""
    task = dataclasses.replace(TASK, max_outline_lengths=TASK.max_outline_lengths / 4)
    force = follow(None, task, settings=dataclasses.replace(SETTINGS, friction=setting))[0].force_n
    x, y, pressure = force[force[..., 2] > 0].T
    assert (np.hypot(x, y) / pressure).max() == pytest.approx(friction, rel=1e-3)
