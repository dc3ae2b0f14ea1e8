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


def test_a_walk_by_the_true_pose_keeps_to_the_edge_and_its_skin_remembers(tmp_path):
    trajectories, contour = follow_contour(
        TASK, TACTIP_331, SETTINGS, METHODS, tmp_path / "disk.npz"
    )
    assert (trajectories.end == LATE).all()
    assert trajectories.steps == 16
    assert not trajectories.failed_contacts.any()
    assert np.abs(trajectories.true[:, -4:, 0]).max() < 0.3  # mm from the edge
    np.testing.assert_allclose(trajectories.way_mm, 15 * 0.5, atol=1.0)
    # friction drags the skin against the way: along the edge, y of the sensor frame
    dragged = trajectories.force_n.sum(axis=1)
    assert (dragged[:, 1] < -0.1 * dragged[:, 2]).all()
    row = score_trajectories(trajectories, contour, "disk")[0]
    assert row.name == "disk/true" and row.closed == 0 and row.ends == {"took too long": 2}
    assert row.completed == pytest.approx(7.5 / contour.length, rel=0.15)
    assert len(row.walk_mm) == 2 and min(row.walk_mm) <= row.mean_mm <= max(row.walk_mm)
    np.testing.assert_allclose(
        compute_perceived_edge(trajectories, 0)[-1],
        contour.points[contour.at(trajectories.arc_mm[0])],
        atol=0.3,
    )


def test_a_killed_walk_goes_on_and_ends_equal(tmp_path, monkeypatch):
    monkeypatch.setattr(servo, "SAVE_EVERY", 5)
    calls = []

    def perceive(images):
        """Estimate an edge that depends on the full image."""
        calls.append(1)
        full, half = images.mean(axis=(1, 2)), images[:, :64].mean(axis=(1, 2))
        return full / images.max(), half / images.max()

    def perceive_until_killed(images):
        if len(calls) == 25:
            raise KeyboardInterrupt
        return perceive(images)

    full, _ = follow_contour(TASK, TACTIP_331, SETTINGS, {"a": perceive}, tmp_path / "full.npz")
    assert len(calls) == full.steps == 16
    with pytest.raises(KeyboardInterrupt):
        follow_contour(
            TASK, TACTIP_331, SETTINGS, {"a": perceive_until_killed}, tmp_path / "disk.npz"
        )
    assert load_trajectories(tmp_path / "disk.npz")[1].steps == 5
    again, _ = follow_contour(TASK, TACTIP_331, SETTINGS, {"a": perceive}, tmp_path / "disk.npz")
    assert len(calls) == 25 + 11
    for field in ("point", "perceived", "images", "force_n", "sums", "way_mm", "end"):
        np.testing.assert_array_equal(getattr(again, field), getattr(full, field), err_msg=field)
    with pytest.raises(UserError, match="other settings"):
        follow_contour(
            dataclasses.replace(TASK, depth_mm=3.0),
            TACTIP_331,
            SETTINGS,
            {"a": perceive},
            tmp_path / "disk.npz",
        )
    (tmp_path / "disk.npz").write_bytes(b"torn")
    with pytest.raises(UserError, match="delete it"):
        follow_contour(TASK, TACTIP_331, SETTINGS, {"a": perceive}, tmp_path / "disk.npz")


def test_a_walk_that_is_misled_is_lost_and_reported(tmp_path):
    # says "go outwards"
    astray = {"astray": lambda images: (np.full(len(images), -5.0), np.zeros(len(images)))}
    trajectories, contour = follow_contour(
        TASK, TACTIP_331, SETTINGS, astray, tmp_path / "disk.npz"
    )
    assert (trajectories.end == LOST).all() and trajectories.steps < 16
    row = score_trajectories(trajectories, contour, "disk")[0]
    assert row.ends == {"lost the edge": 2} and row.largest_mm > servo.MAX_EDGE_DISTANCE_MM


def test_a_walk_around_an_outline_of_ones_own_closes_and_is_found_again(tmp_path):
    task = ServoTask(
        trace_outline("coin", lambda xy: np.hypot(*xy.T) - 5, within_mm=8), starts=1, depth_mm=2.0
    )
    trajectories, contour = follow_contour(
        task, TACTIP_331, SETTINGS, METHODS, tmp_path / "coin.npz"
    )
    assert load_trajectories(tmp_path / "coin.npz")[0] == task
    assert trajectories.end[0] == CLOSED and trajectories.way_mm[0] >= contour.length
    row = score_trajectories(trajectories, contour, "coin")[0]
    assert row.closed == 1
    assert row.completed == 1
    assert row.mean_mm < 0.5
    assert row.ends == {"closed": 1}


def test_starts_are_spread_and_the_same_for_a_seed():
    contour = trace_contour(STIMULI["disk"])
    points = sample_start_points(ServoTask("disk", starts=4), contour)
    np.testing.assert_array_equal(points, sample_start_points(ServoTask("disk", starts=4), contour))
    assert not np.array_equal(
        points, sample_start_points(ServoTask("disk", starts=4, seed=1), contour)
    )
    distances = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=-1) + 1e3 * np.eye(4)
    assert distances.min() > 60


def test_walks_of_other_networks_or_another_sensor_are_not_taken_for_these(tmp_path):
    file = tmp_path / "disk.npz"
    follow_contour(TASK, TACTIP_331, SETTINGS, METHODS, file, {"true": "a"})
    follow_contour(TASK, TACTIP_331, SETTINGS, METHODS, file, {"true": "a"})
    smaller = dataclasses.replace(
        SETTINGS, preprocess=dataclasses.replace(SETTINGS.preprocess, size=64)
    )
    for sensor, settings, digest in (
        (TACTIP_331, SETTINGS, "b"),
        (TACTIP_127, SETTINGS, "a"),
        (TACTIP_331, smaller, "a"),
    ):
        with pytest.raises(UserError, match="another model or sensor"):
            follow_contour(TASK, sensor, settings, METHODS, file, {"true": digest})


@pytest.mark.parametrize(("setting", "friction"), [(None, STIMULI["disk"].friction), (0.2, 0.2)])
def test_walks_touch_with_the_friction_of_the_data(setting, friction):
    """Check Coulomb's law: slipping skin pulls by friction times pressure, and no skin more."""
    settings = dataclasses.replace(SETTINGS, friction=setting)
    trajectories, _ = follow_contour(
        dataclasses.replace(TASK, max_outline_lengths=TASK.max_outline_lengths / 4),
        TACTIP_331,
        settings,
        METHODS,
    )
    x, y, pressure = trajectories.force_n[trajectories.force_n[..., 2] > 0].T
    assert (np.hypot(x, y) / pressure).max() == pytest.approx(friction, rel=1e-3)
