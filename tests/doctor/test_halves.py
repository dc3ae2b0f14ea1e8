"""Taps, slides and the pairs among them, on labels made up for it."""

import numpy as np
import pytest

from jaxunshear.doctor.halves import column, full_circle, pairing, taps_and_slides


def labels(*rows):
    return np.array(rows, float)


TAPS = labels([0, 1, 3, 0, 0, -179], [0, -2, 4, 0, 0, 90])
STILL = np.zeros((2, 6))


def test_a_contact_whose_move_is_not_known_is_neither():
    moves = labels([0] * 6, [0, 0, 0, 0, 0, 1e-3], [np.nan] * 6, [0, 0, np.nan, 0, 0, 0], [1e-9] * 6)
    taps, slides = taps_and_slides(moves, 5)
    assert taps.tolist() == [True, False, False, False, True]
    assert slides.tolist() == [False, True, False, False, False]
    assert not np.any(taps_and_slides(None, 3))


@pytest.mark.parametrize(
    ("angles", "full"),
    [
        (np.arange(0, 360, 19.0), True),
        (np.arange(-180, 180, 15.0), True),
        (np.arange(0, 330, 5.0), False),
        (np.arange(-20, 20, 1.0), False),
        ([0.0, 360.0], False),
        ([7.0], False),
    ],
)
def test_a_full_circle_has_no_gap(angles, full):
    assert full_circle(np.array(angles)) is full


def test_what_a_column_holds():
    assert column("pose_1", "mm", np.array([np.nan, np.nan])) is None
    found = column("pose_2", "mm", np.array([3.0, np.nan, -1.0]))
    assert (found.low, found.high, found.circle, found.varies) == (-1, 3, False, True)
    assert not column("pose_2", "mm", np.array([2.0, 2.0])).varies
    assert column("pose_6", "deg", np.arange(0.0, 360.0)).circle
    assert not column("pose_1", "mm", np.arange(0.0, 360.0)).circle


def test_the_nearest_tap_across_the_seam_of_the_circle():
    """179.5 and -179 degrees are 1.5 apart."""
    slides = labels([0, 1.3, 3.4, 0, 0, 179.5])
    found = pairing(np.vstack([TAPS, slides]), np.vstack([STILL, STILL[:1] + 1]), None, 3)
    assert (found.taps, found.slides, found.by_id) == (2, 1, 0)
    assert found.gap_mm == pytest.approx(0.5)
    assert found.gap_deg == pytest.approx(1.5)


def test_pairs_by_number_need_the_same_pose():
    """The second slide's number is that of another pose's tap; the third's pose is that of a tap of another number."""
    slides = labels([0, 1, 3, 0, 0, 181], [0, 5, 3, 0, 0, 90], [0, -2, 4, 0, 0, 90])
    poses, moves = np.vstack([TAPS, slides]), np.vstack([STILL, np.ones((3, 6))])
    assert pairing(poses, moves, np.array([7, 8, 7, 8, 7]), 5).by_id == 1
    assert pairing(poses, moves, np.array([-1, -1, -1, -1, -1]), 5).by_id == 0
    assert pairing(poses, moves, np.array([7, 8, 7, 9, 8]), 5).by_id == 2


def test_without_poses_or_without_taps_there_are_no_pairs():
    assert pairing(None, STILL, None, 2) == pairing(TAPS * np.nan, STILL, None, 2)
    assert pairing(TAPS, STILL, None, 2).gap_mm is None
    assert pairing(None, None, None, 2).taps == 0
