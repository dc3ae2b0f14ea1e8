"""Pins turned about the sensor's axis: exact on a lattice with that symmetry, close where pins are in between, refused where labels do
not turn with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.targets import make_label_targets
from jaxunshear.errors import UserError
from jaxunshear.models.posenet import scale_poses
from jaxunshear.training.augmentation import (
    ANGLES,
    find_rotation_sense,
    make_pair_rotation,
    make_rotations,
    rotate_outputs,
    rotate_pins,
)

MIDDLE = np.array([60.0, 64.0])


def hexagons(rings):
    """(P, 2) px: rings of 6, 12, 18, ... pins about the middle one."""
    places = [(0.0, 0.0)]
    for ring in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        places += zip(5 * ring * np.cos(angle), 5 * ring * np.sin(angle), strict=True)
    return MIDDLE + np.array(places)


REST = hexagons(7)
RNG = np.random.default_rng(0)


def touched(twist_deg, across_mm):
    """Pins under an edge across the sensor: pushed to both of its sides, smoothly."""
    angle = np.radians(twist_deg)
    normal = np.array([np.cos(angle), np.sin(angle)])
    away = (REST - MIDDLE) @ normal - 5 * across_mm
    return REST + 2 * np.outer(
        away / 8 * np.exp(-((away / 12) ** 2)) + 0.3 * np.exp(-((away / 20) ** 2)), normal
    )


def contacts(count, sense):
    poses = np.zeros((count, 6))
    poses[:, 1], poses[:, 5] = RNG.uniform(-3, 3, count), RNG.uniform(-180, 180, count)
    pins = np.stack([touched(sense * pose[5], pose[1]) for pose in poses])
    return pins.astype(np.float32), poses


@pytest.mark.parametrize("jit", [False, True])
def test_a_sixth_of_a_turn_takes_every_pin_to_another(jit):
    turns, k = make_rotations(REST, 1), ANGLES // 6
    pins = REST + RNG.normal(0, 1, (2, *REST.shape))
    got = (jax.jit(rotate_pins) if jit else rotate_pins)(turns, k, jnp.asarray(pins))
    rotation = np.asarray(turns.rotation[k], np.float64)
    turned = MIDDLE + (REST - MIDDLE) @ rotation.T
    lands = np.argmin(np.linalg.norm(turned[:, None] - REST, axis=-1), axis=1)
    wanted = np.empty_like(pins)
    wanted[:, lands] = MIDDLE + (pins - MIDDLE) @ rotation.T
    np.testing.assert_allclose(got, wanted, atol=1e-3)


def test_no_turn_changes_nothing_and_pins_that_are_not_seen_count_as_untouched():
    turns, pins = make_rotations(REST, 1), np.array(touched(20, 1.5)[None], np.float32)
    np.testing.assert_allclose(rotate_pins(turns, 0, jnp.asarray(pins)), pins, atol=1e-4)
    hidden, still = pins.copy(), pins.copy()
    hidden[0, 5], still[0, 5] = np.nan, REST[5]
    np.testing.assert_array_equal(
        *(rotate_pins(turns, 3, jnp.asarray(each)) for each in (hidden, still))
    )


@pytest.mark.parametrize("k", [1, 5, 17])
def test_a_turned_touch_is_the_touch_of_a_turned_edge(k):
    turned_by = 360 * k / ANGLES
    got = rotate_pins(make_rotations(REST, 1), k, jnp.asarray(touched(20, 1.5)[None]))[0]
    wanted = touched(20 + turned_by, 1.5)
    assert np.sqrt(np.mean((got - wanted) ** 2)) < 0.05 * np.sqrt(np.mean((wanted - REST) ** 2))


@pytest.mark.parametrize("sense", [1, -1])
def test_the_twist_turns_and_nothing_else(sense):
    _, poses = contacts(40, 1)
    targets, k = make_label_targets((), poses), 7
    after = poses + np.array([0, 0, 0, 0, 0, sense * 360 * k / ANGLES])
    outputs, wanted = (
        scale_poses({"pose": jnp.asarray(each, jnp.float32)}, targets) for each in (poses, after)
    )
    found = rotate_outputs(make_rotations(REST, sense), k, outputs, targets)
    np.testing.assert_allclose(found, wanted, atol=1e-5)


@pytest.mark.parametrize("sense", [1, -1])
def test_the_sense_is_found_in_the_recordings(sense):
    pins, poses = contacts(600, sense)
    assert find_rotation_sense(REST, pins, poses, make_label_targets((), poses)) == sense


def test_touches_that_do_not_turn_with_their_label_are_refused():
    pins, poses = contacts(600, 1)
    with pytest.raises(UserError, match="turned touches do not resemble recorded ones"):
        find_rotation_sense(REST, pins[RNG.permutation(600)], poses, make_label_targets((), poses))
    with pytest.raises(UserError, match="asks for Rz_deg over the full circle"):
        find_rotation_sense(REST, pins, poses, make_label_targets(("y_mm", "Rz_deg:range"), poses))


@pytest.mark.parametrize("jit", [False, True])
def test_mirrored_pins_are_those_of_a_mirrored_touch(jit):
    """The rings have the mirror of each of their rotations by a sixth of a turn."""
    mirror = make_rotations(REST, 1, mirrored=True)
    pins = jnp.asarray(touched(20, 1.5)[None])
    for k in (0, ANGLES // 6):
        got = (jax.jit(rotate_pins) if jit else rotate_pins)(mirror, ANGLES + k, pins)[0]
        wanted = touched(-20 + 360 * k / ANGLES, 1.5)
        np.testing.assert_allclose(got, wanted, atol=1e-3)


def make_pairs():
    taps, poses = contacts(5, 1)
    slides = taps + np.float32([0.7, -0.2])
    return {"canonical_pins": taps, "sheared_pins": slides, "pose": np.float32(poses)}


def test_slides_turn_with_their_taps():
    batch, rotate = make_pairs(), jax.jit(make_pair_rotation(REST, 1.0))
    directions = []
    for seed in range(30):
        got, is_rotated = rotate(batch, jax.random.key(seed))
        assert is_rotated
        np.testing.assert_array_equal(got["pose"], batch["pose"])
        drag = np.asarray(got["sheared_pins"] - got["canonical_pins"])
        np.testing.assert_allclose(drag, np.broadcast_to(drag[0, 0], drag.shape), atol=1e-3)
        assert np.hypot(*drag[0, 0]) == pytest.approx(np.hypot(0.7, 0.2), abs=1e-3)
        directions.append(np.degrees(np.arctan2(*drag[0, 0, ::-1])))
    # half of them are of mirrored slides, whose direction is turned by steps from its mirror
    given = np.degrees(np.arctan2(-0.2, 0.7))
    off = [abs((each - given + 7.5) % 15 - 7.5) for each in directions]
    mirrored = [abs((each + given + 7.5) % 15 - 7.5) for each in directions]
    assert 5 < sum(np.less(off, 0.1)) < 25
    np.testing.assert_array_less(np.minimum(off, mirrored), 0.1)


def test_as_many_batches_turn_as_the_share_says():
    batch, rotate = make_pairs(), jax.jit(make_pair_rotation(REST, 0.3))
    count = 0
    for seed in range(200):
        got, is_rotated = rotate(batch, jax.random.key(seed))
        count += bool(is_rotated)
        if not is_rotated:
            for name, value in batch.items():
                np.testing.assert_array_equal(got[name], value, err_msg=name)
    assert 40 < count < 80


def test_a_square_pad_turns_by_its_own_rotations_alone():
    columns, rows = np.meshgrid(np.arange(9.0) * 8, np.arange(9.0) * 8)
    rest = np.stack([columns.ravel(), rows.ravel()], -1)
    batch = {"sheared_pins": np.float32(rest[None] + [1.0, 0.0])}
    rotate = jax.jit(make_pair_rotation(rest, 1.0))
    turned = [rotate(batch, jax.random.key(seed))[0]["sheared_pins"] for seed in range(40)]
    drags = {tuple(np.round(np.asarray(pins[0, 0]) - rest[0])) for pins in turned}
    assert drags == {(1, 0), (-1, 0), (0, 1), (0, -1)}


def test_missing_pins_stay_missing_where_they_are_turned_to():
    batch, rotate = make_pairs(), jax.jit(make_pair_rotation(REST, 1.0))
    batch["canonical_pins"][:, 0] = np.nan  # the middle one, which stays in place
    for seed in range(10):
        got, _ = rotate(batch, jax.random.key(seed))
        is_missing = np.isnan(got["canonical_pins"]).any(-1)
        assert is_missing[:, 0].all() and is_missing.sum() == len(is_missing)
        assert np.isfinite(got["sheared_pins"]).all()
