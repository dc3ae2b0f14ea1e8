"""Pins keep their identities through large motions; those one place too far are taken back."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxunshear.angles import rotation_2d
from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, Sensor
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import (
    compute_rings,
    estimate_rings,
    find_neighbours,
    make_lattice,
)
from jaxunshear.perception.lattice_fitting import MarkerLayout, fit_lattice, make_layout
from jaxunshear.perception.pin_detection import DetectedPins
from jaxunshear.perception.pin_track import (
    MAX_OFFSET,
    assess_track,
    rate_identities,
    repair_identities,
)
from jaxunshear.perception.pin_tracking import track_pins
from jaxunshear.simulator.pin_layout import compute_pin_lattice

RIM_PX = 46.0  # as at 128 px


def _flat(sensor: Sensor) -> np.ndarray:
    return compute_pin_lattice(sensor) / (sensor.rings * sensor.pin_spacing_mm) * RIM_PX + 64


def _slid(place: np.ndarray, shift_px: float, width_px: float = 22.0) -> np.ndarray:
    """A field that moves the middle by `shift_px` along the columns and hardly the rim."""
    bell = np.exp(-np.sum((place - 64) ** 2, axis=-1) / (2 * width_px**2))
    return place + shift_px * np.stack([bell, 0.3 * bell], axis=-1)


PLACE = _flat(TACTIP_331)
LATTICE = make_lattice(PLACE, compute_rings(TACTIP_331))


def moved():
    return _slid(PLACE, 5.0, 14.0) + np.random.default_rng(0).normal(0, 0.1, PLACE.shape)


@pytest.mark.parametrize("sensor", [TACTIP_331, TACTIP_127])
@pytest.mark.parametrize("shift_px", [0.0, 3.0, 7.0])
def test_identities(sensor, shift_px):
    rng = np.random.default_rng(0)
    place = _flat(sensor)
    order = rng.permutation(len(place))
    found = (_slid(place, shift_px) + rng.normal(0, 0.1, place.shape))[order]
    track = track_pins(make_lattice(place, compute_rings(sensor)), DetectedPins(found))
    assert track.identified and track.missed == track.extra == 0
    np.testing.assert_array_equal(order[track.identity], np.arange(len(place)))
    if sensor is TACTIP_331 and shift_px == 7:  # the nearest place would be a wrong one
        nearest = cKDTree(place).query(_slid(place, shift_px))[1]
        assert np.mean(nearest != np.arange(len(place))) > 0.2


def test_missing_and_extra_pins_are_counted():
    seen = np.delete(_slid(PLACE, 3.0), [0, 40, 200], axis=0)
    found = np.concatenate([seen, [[70.3, 66.1], [20.0, 40.0]]])
    track = track_pins(LATTICE, DetectedPins(found))
    # an extra pin may stand in for a missing neighbour
    assert track.missed <= 3 and track.extra >= 1
    assert np.isnan(track.motion).any(axis=-1).sum() == track.missed


def test_scrambled_pins_are_not_sure():
    scrambled = np.random.default_rng(1).uniform(16, 112, PLACE.shape)
    for pins in (scrambled, PLACE[:100]):
        assert not track_pins(make_lattice(PLACE), DetectedPins(pins)).identified


def shuffle(place, rng, noise_px):
    """Return four frames of the pins, in any order."""
    count = len(place)
    return [place[rng.permutation(count)] + rng.normal(0, noise_px, place.shape) for _ in range(4)]


@pytest.mark.parametrize("sensor", [TACTIP_331, TACTIP_127], ids=lambda sensor: sensor.name)
def test_rings_of_any_layout_are_those_of_the_sensor(sensor):
    """Steps to the outline, over neighbours, are the rings it is built of; also with holes."""
    ring = np.repeat(np.arange(sensor.rings + 1), [1] + [6 * k for k in range(1, sensor.rings + 1)])
    place = _flat(sensor) + np.random.default_rng(0).normal(0, 0.1, (sensor.pins, 2))
    assert np.array_equal(estimate_rings(place), ring)
    assert np.array_equal(estimate_rings(place[::-1]), ring[::-1])
    seen = ~np.isin(np.arange(sensor.pins), (5, 40))
    assert np.array_equal(estimate_rings(place[seen]), ring[seen])
    assert (
        np.bincount(
            find_neighbours(np.argwhere(np.ones((5, 5))).astype(float)).ravel(), minlength=25
        )
        <= 4
    ).all()
    line = np.stack([np.arange(30.0), np.zeros(30)], axis=-1)
    assert not estimate_rings(line).any()  # all of them are on the outline


def test_lattice_is_found_turned_and_shifted():
    """Each pin is within a tenth of a pixel, up to the lattice's symmetry."""
    turned = (PLACE - 64) @ rotation_2d(-np.radians(17)) + [60.0, 66.0]
    frames = shuffle(turned, np.random.default_rng(2), 0.05)
    lattice = fit_lattice(frames, make_layout(TACTIP_331))
    off = np.min(np.linalg.norm(lattice.rest[:, None] - turned[None], axis=-1), axis=1)
    assert off.max() < 0.15
    np.testing.assert_allclose(lattice.centre, [60, 66], atol=0.1)
    radius, expected = lattice.rest - lattice.centre, RIM_PX / 10 * compute_rings(TACTIP_331)
    np.testing.assert_allclose(np.linalg.norm(radius, axis=-1), expected, atol=0.2)


def test_another_sensor_is_refused():
    with pytest.raises(UserError, match="tactip127"):
        fit_lattice([PLACE], make_layout(TACTIP_127))


def test_a_pin_without_company_counts_as_not_seen():
    motion = np.zeros_like(PLACE)
    rim = int(np.argmax(PLACE[:, 0]))
    motion[LATTICE.neighbours[rim, :7]] = np.nan
    motion[rim] = (0.9 * LATTICE.spacing, 0)  # the neighbour's place: nobody is left who could say
    track = assess_track(LATTICE, motion, np.arange(len(PLACE)), len(PLACE))
    assert not track.visible[rim] and track.missed == 8


@pytest.mark.parametrize("lattice", ["square", "hexagons"])
@pytest.mark.parametrize("turn_deg", [-2.0, 0.0, 3.0])
def test_noise_does_not_choose_which_pin_is_which(lattice, turn_deg):
    """Of a user's layout nobody knows the symmetry; pins are named for the least turn."""
    flat = compute_pin_lattice(TACTIP_127)
    if lattice == "square":
        flat = np.stack(np.meshgrid(*[np.arange(11.0) - 5] * 2), axis=-1).reshape(-1, 2)
    flat = flat / np.linalg.norm(flat, axis=-1).max()
    place = 46 * flat @ rotation_2d(-np.radians(turn_deg)) + 64
    frames = shuffle(place, np.random.default_rng(0), 0.15)
    found = fit_lattice(frames, MarkerLayout("layout", flat, estimate_rings(flat), 360.0))
    np.testing.assert_allclose(found.rest, place, atol=0.5)


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
    right = repair_identities(LATTICE, found, before)
    np.testing.assert_array_equal(right, np.arange(len(found)))
    again = rate_identities(LATTICE, found, right)
    assert again.calm and repair_identities(LATTICE, found, again) is right


def test_a_hidden_side_stays_empty():
    found = moved()
    found = found[found[:, 0] < 100]
    off, nearest = cKDTree(found).query(moved())
    which = np.where(off < 1e-9, nearest, -1)
    got = repair_identities(LATTICE, found, rate_identities(LATTICE, found, which))
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
