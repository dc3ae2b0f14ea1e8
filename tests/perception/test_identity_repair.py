"""Pins that settled one place too far are taken back and come out right."""

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.perception.lattice import compute_rings, make_lattice
from jaxunshear.perception.pin_track import (
    MAX_OFFSET,
    assess_track,
    rate_identities,
    repair_identities,
)
from jaxunshear.simulator.pin_layout import compute_pin_lattice

PLACE = compute_pin_lattice(TACTIP_331) / 2.0 * 4.5 + 64
LATTICE = make_lattice(PLACE, compute_rings(TACTIP_331))


def moved():
    bell = np.exp(-np.sum((PLACE - 64) ** 2, axis=-1) / (2 * 14**2))
    noise = np.random.default_rng(0).normal(0, 0.1, PLACE.shape)
    return PLACE + 5 * np.stack([bell, 0.3 * bell], axis=-1) + noise


def one_place_off(place, count=6):
    """Rows of the found pins, a row of them each in its neighbour's stead; the last has none."""
    which = np.arange(len(place))
    row = np.flatnonzero(LATTICE.ring == 6)[:count]
    which[row[:-1]] = row[1:]
    which[row[-1]] = -1
    return which, row


def test_a_row_one_place_off_is_repaired():
    found = moved()
    wrong, row = one_place_off(found)
    before = rate_identities(LATTICE, found, wrong)
    assert not before.calm and before.offset[row].max() > 2 * MAX_OFFSET
    right = repair_identities(LATTICE, found, cKDTree(found), wrong)
    np.testing.assert_array_equal(right, np.arange(len(found)))
    assert rate_identities(LATTICE, found, right).calm
    np.testing.assert_array_equal(repair_identities(LATTICE, found, cKDTree(found), right), right)


def test_a_hidden_side_stays_empty():
    found = moved()
    found = found[found[:, 0] < 100]
    off, nearest = cKDTree(found).query(moved())
    which = np.where(off < 1e-9, nearest, -1)
    got = repair_identities(LATTICE, found, cKDTree(found), which)
    np.testing.assert_array_equal(got, which)


def test_a_row_one_place_off_is_not_sure_though_it_is_smooth_elsewhere():
    found = moved()
    wrong, _ = one_place_off(found)
    motion = np.where(wrong[:, None] >= 0, found[wrong] - PLACE, np.nan)
    assert not assess_track(LATTICE, motion, wrong, len(found)).identified
    assert assess_track(LATTICE, found - PLACE, np.arange(len(found)), len(found)).identified


def test_pins_missing_on_one_side_and_left_over_on_the_other_are_not_sure():
    which = np.where(PLACE[:, 0] > np.sort(PLACE[:, 0])[5], np.arange(len(PLACE)), -1)
    motion = np.where(which[:, None] >= 0, 0.0, np.nan) + np.zeros_like(PLACE)
    assert assess_track(LATTICE, motion, which, len(PLACE) - 6).identified  # hidden ones
    assert not assess_track(LATTICE, motion, which, len(PLACE)).identified


def test_filled_and_off_neighbours():
    flat = np.tile([1.5, -0.5], (len(PLACE), 1))
    holes = flat.copy()
    holes[40:50] = np.nan
    np.testing.assert_allclose(LATTICE.fill_missing(holes), flat, atol=0.02)
    off = LATTICE.measure_offsets(holes)
    assert off.max() < 0.01 and (off[40:50] == 0).all()
