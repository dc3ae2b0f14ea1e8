"""Contour following: the loop keeps its history, goes on after a kill, and says how each walk ended."""

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
COURSE = ServoTask(
    "disk", starts=2, depth_mm=2.0, max_outline_lengths=16 * 0.5 / LENGTH * 0.999
)  # 16 steps
WAYS = {"true": None}


def test_a_walk_by_the_true_pose_keeps_to_the_edge_and_its_skin_remembers(tmp_path):
    walks, line = follow_contour(COURSE, TACTIP_331, SETTINGS, WAYS, tmp_path / "disk.npz")
    assert (walks.end == LATE).all() and walks.steps == 16 and not walks.failed_contacts.any()
    assert np.abs(walks.true[:, -4:, 0]).max() < 0.3  # mm from the edge
    np.testing.assert_allclose(walks.way_mm, 15 * 0.5, atol=1.0)
    # friction drags the skin against the way: along the edge, y of the sensor frame
    dragged = walks.force_n.sum(axis=1)
    assert (dragged[:, 1] < -0.1 * dragged[:, 2]).all()
    row = score_trajectories(walks, line, "disk")[0]
    assert row.name == "disk/true" and row.closed == 0 and row.ends == {"took too long": 2}
    assert row.completed == pytest.approx(7.5 / line.length, rel=0.15)
    assert len(row.walk_mm) == 2 and min(row.walk_mm) <= row.mean_mm <= max(row.walk_mm)
    np.testing.assert_allclose(
        compute_perceived_edge(walks, 0)[-1], line.points[line.at(walks.arc_mm[0])], atol=0.3
    )


def test_a_killed_walk_goes_on_and_ends_equal(tmp_path, monkeypatch):
    monkeypatch.setattr(servo, "SAVE_EVERY", 5)
    taken = []

    def seen(images):
        """An edge that depends on all that the camera sees."""
        taken.append(1)
        return images.mean(axis=(1, 2)) / images.max(), images[:, :64].mean(
            axis=(1, 2)
        ) / images.max()

    def killed(images):
        if len(taken) == 25:
            raise KeyboardInterrupt
        return seen(images)

    full, _ = follow_contour(COURSE, TACTIP_331, SETTINGS, {"a": seen}, tmp_path / "full.npz")
    assert len(taken) == full.steps == 16
    with pytest.raises(KeyboardInterrupt):
        follow_contour(COURSE, TACTIP_331, SETTINGS, {"a": killed}, tmp_path / "disk.npz")
    assert load_trajectories(tmp_path / "disk.npz")[1].steps == 5
    again, _ = follow_contour(COURSE, TACTIP_331, SETTINGS, {"a": seen}, tmp_path / "disk.npz")
    assert len(taken) == 25 + 11
    for field in ("point", "perceived", "images", "force_n", "sums", "way_mm", "end"):
        np.testing.assert_array_equal(getattr(again, field), getattr(full, field), err_msg=field)
    with pytest.raises(UserError, match="other settings"):
        follow_contour(
            dataclasses.replace(COURSE, depth_mm=3.0),
            TACTIP_331,
            SETTINGS,
            {"a": seen},
            tmp_path / "disk.npz",
        )
    (tmp_path / "disk.npz").write_bytes(b"torn")
    with pytest.raises(UserError, match="delete it"):
        follow_contour(COURSE, TACTIP_331, SETTINGS, {"a": seen}, tmp_path / "disk.npz")


def test_a_walk_that_is_misled_is_lost_and_reported(tmp_path):
    astray = {
        "astray": lambda images: (np.full(len(images), -5.0), np.zeros(len(images)))
    }  # "go outwards"
    walks, line = follow_contour(COURSE, TACTIP_331, SETTINGS, astray, tmp_path / "disk.npz")
    assert (walks.end == LOST).all() and walks.steps < 16
    row = score_trajectories(walks, line, "disk")[0]
    assert row.ends == {"lost the edge": 2} and row.largest_mm > servo.MAX_EDGE_DISTANCE_MM


def test_a_walk_around_an_outline_of_ones_own_closes_and_is_found_again(tmp_path):
    course = ServoTask(
        trace_outline("coin", lambda xy: np.hypot(*xy.T) - 5, within_mm=8), starts=1, depth_mm=2.0
    )
    walks, line = follow_contour(course, TACTIP_331, SETTINGS, WAYS, tmp_path / "coin.npz")
    assert load_trajectories(tmp_path / "coin.npz")[0] == course
    assert walks.end[0] == CLOSED and walks.way_mm[0] >= line.length
    row = score_trajectories(walks, line, "coin")[0]
    assert (
        row.closed == 1 and row.completed == 1 and row.mean_mm < 0.5 and row.ends == {"closed": 1}
    )


def test_starts_are_spread_and_the_same_for_a_seed():
    line = trace_contour(STIMULI["disk"])
    points = sample_start_points(ServoTask("disk", starts=4), line)
    np.testing.assert_array_equal(points, sample_start_points(ServoTask("disk", starts=4), line))
    assert not np.array_equal(
        points, sample_start_points(ServoTask("disk", starts=4, seed=1), line)
    )
    apart = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=-1) + 1e3 * np.eye(4)
    assert apart.min() > 60


def test_walks_of_other_networks_or_another_sensor_are_not_taken_for_these(tmp_path):
    file = tmp_path / "disk.npz"
    follow_contour(COURSE, TACTIP_331, SETTINGS, WAYS, file, {"true": "a"})
    follow_contour(COURSE, TACTIP_331, SETTINGS, WAYS, file, {"true": "a"})
    smaller = dataclasses.replace(
        SETTINGS, preprocess=dataclasses.replace(SETTINGS.preprocess, size=64)
    )
    for sensor, settings, digest in (
        (TACTIP_331, SETTINGS, "b"),
        (TACTIP_127, SETTINGS, "a"),
        (TACTIP_331, smaller, "a"),
    ):
        with pytest.raises(UserError, match="another model or sensor"):
            follow_contour(COURSE, sensor, settings, WAYS, file, {"true": digest})


@pytest.mark.parametrize(("asked", "used"), [(None, STIMULI["disk"].friction), (0.2, 0.2)])
def test_walks_touch_with_the_friction_of_the_data(asked, used):
    """Coulomb's law: where skin slips its pull is the friction times the pressure, and nowhere is it more."""
    settings = dataclasses.replace(SETTINGS, friction=asked)
    walks, _ = follow_contour(
        dataclasses.replace(COURSE, max_outline_lengths=COURSE.max_outline_lengths / 4),
        TACTIP_331,
        settings,
        WAYS,
    )
    x, y, pressure = walks.force_n[walks.force_n[..., 2] > 0].T
    assert (np.hypot(x, y) / pressure).max() == pytest.approx(used, rel=1e-3)
