"""Baselines on images whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.evaluation.network_outputs import (
    MAX_TAPS,
    collect_training_taps,
    find_nearest_images,
    make_baseline_images,
    translate_to_target,
)

SIZE = 32


def dots(seed, count=1):
    return (np.random.default_rng(seed).random((count, SIZE, SIZE, 1)) < 0.15).astype(np.float32)


def moved(image, rows, columns):
    """By full pixels, black flowing in."""
    framed = np.pad(image[..., 0], SIZE)
    return framed[SIZE - rows : 2 * SIZE - rows, SIZE - columns : 2 * SIZE - columns, None]


@pytest.mark.parametrize("jit", [False, True])
@pytest.mark.parametrize(("rows", "columns"), [(0, 0), (3, -5), (-8, 8), (7, 2)])
def test_the_translation_that_was_made_is_undone(rows, columns, jit):
    inner = np.zeros((SIZE, SIZE, 1), np.float32)
    inner[9:-9, 9:-9] = dots(0)[0, 9:-9, 9:-9]  # nothing leaves the view
    found = (jax.jit(translate_to_target) if jit else translate_to_target)(
        moved(inner, rows, columns), inner
    )
    np.testing.assert_array_equal(found, inner)


def test_no_translation_within_reach_is_nearer():
    image, target = jnp.asarray(dots(1)[0]), jnp.asarray(dots(2)[0])
    found = float(jnp.mean((translate_to_target(image, target) - target) ** 2))
    away = [
        np.mean((moved(np.asarray(image), rows, columns) - np.asarray(target)) ** 2)
        for rows in range(-8, 9)
        for columns in range(-8, 9)
    ]
    assert found == pytest.approx(min(away), abs=1e-7)


def test_the_nearest_is_found():
    known = dots(3, 7)
    np.testing.assert_array_equal(
        find_nearest_images(known, known[[4, 2]] * 0.9 + 0.05), known[[4, 2]]
    )


def test_the_mean_is_that_of_the_taps_given():
    taps = (dots(4, 6) * 255).astype(np.uint8)
    found = make_baseline_images(taps, dots(5, 2), dots(6, 2))
    np.testing.assert_allclose(found["mean_tap"][1], taps.mean(0) / 255, atol=1e-6)
    assert all(image.shape == (2, SIZE, SIZE, 1) for image in found.values())


def test_one_tap_of_every_pose_is_kept_and_not_too_many():
    count = 2 * (MAX_TAPS + 100)
    batch = {
        "canonical": np.arange(count, dtype=np.int64)[:, None, None, None],
        "stimulus": np.arange(count) % 2,
        "pose_id": np.arange(count) // 4,
    }
    halves = [
        {name: value[part] for name, value in batch.items()}
        for part in (slice(0, 99), slice(99, None))
    ]
    found = collect_training_taps(halves).ravel()
    assert len(found) == MAX_TAPS
    assert set(found % 4) == {0, 1}  # the first of each pose and stimulus
    assert found[0] == 0
    assert found[-1] == count - 3
