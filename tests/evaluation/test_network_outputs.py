"""The adapter from networks on disk to outputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import ALL_NETWORKS, NETWORKS
from jaxunshear.config.targets import list_target_names, make_range_targets
from jaxunshear.errors import UserError
from jaxunshear.evaluation import network_outputs
from jaxunshear.evaluation.network_outputs import (
    MAX_TAPS,
    collect_training_taps,
    find_nearest_images,
    make_baseline_images,
    translate_to_target,
)
from jaxunshear.evaluation.score import BASELINES, CELLS, DIRECT_KIND, TARGET_KIND, list_pose_kinds
from jaxunshear.models.modality import IMAGES

PAPER_KINDS = ("tap", "sheared", "entangled", "disentangled")
TARGETS = make_range_targets((), Ranges())
QUANTITIES = list_target_names(TARGETS)


def images(count=2):
    return (np.random.default_rng(0).random((count, 32, 32, 1)) < 0.3).astype(np.uint8) * 255


def test_outputs_and_scores_of_trained_networks(trained):
    run = network_outputs.load_run(trained, NETWORKS, IMAGES)
    outputs, scores = run(images(), images()[::-1])
    assert set(outputs.images) == set(PAPER_KINDS)
    assert set(outputs.cells) == set(CELLS)
    for image in (*outputs.images.values(), *outputs.cells.values()):
        assert image.shape == (2, 32, 32, 1)
        assert 0 <= float(image.min()) <= float(image.max()) <= 1
    np.testing.assert_array_equal(outputs.images["tap"] * 255, images())
    np.testing.assert_array_equal(outputs.images["disentangled"], outputs.cells["DC(z_p)"])
    for kind in PAPER_KINDS:
        shapes = {name: value.shape for name, value in outputs.poses[kind].items()}
        assert shapes == dict.fromkeys(QUANTITIES, (2,))
    assert all(value.shape == (2,) and np.isfinite(value).all() for value in scores.values())
    assert len(scores) == 3 + 4 * 3


def test_a_missing_network_is_named(trained, tmp_path):
    for name in ("disentangled", "posenet"):
        (tmp_path / name).symlink_to(trained / name)
    with pytest.raises(UserError, match="entangled"):
        network_outputs.load_run(tmp_path, NETWORKS, IMAGES)


def test_rivals_and_baselines_join_in(trained):
    run = network_outputs.load_run(trained, ALL_NETWORKS, IMAGES, taps=images(5))
    outputs, scores = run(images(), images()[::-1])
    assert set(outputs.images) == {*PAPER_KINDS, "entangled_large", "unet", *BASELINES}
    assert set(outputs.poses) == {*list_pose_kinds()} - {TARGET_KIND}
    assert {f"ms_ssim/{kind}" for kind in outputs.images if kind != "tap"} <= set(scores)
    # a PoseNet that learnt from sheared images is given those, with ranges of its own
    run = network_outputs.load_run(trained, ("posenet", "posenet_sheared"), IMAGES)
    same, _ = run(images(), images())
    twice = np.asarray(same.poses[DIRECT_KIND]["x_mm"])
    np.testing.assert_allclose(twice, 2 * np.asarray(same.poses["sheared"]["x_mm"]), rtol=1e-5)


def test_only_what_is_evaluated_is_read_and_run(trained, tmp_path):
    (tmp_path / "entangled").symlink_to(trained / "entangled")
    outputs, scores = network_outputs.load_run(tmp_path, ("entangled",), IMAGES)(images(), images())
    assert set(outputs.images) == {"tap", "sheared", "entangled"}
    assert (outputs.cells, outputs.poses) == ({}, {})
    assert set(scores) == {"ms_ssim/sheared", "ms_ssim/entangled"}


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
    translate = jax.jit(translate_to_target) if jit else translate_to_target
    np.testing.assert_array_equal(translate(moved(inner, rows, columns), inner), inner)


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
    nearest = find_nearest_images(known, known[[4, 2]] * 0.9 + 0.05)
    np.testing.assert_array_equal(nearest, known[[4, 2]])


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
    parts = [{name: value[:99] for name, value in batch.items()}]
    parts.append({name: value[99:] for name, value in batch.items()})
    found = collect_training_taps(parts).ravel()
    assert len(found) == MAX_TAPS
    assert set(found % 4) == {0, 1}  # the first of each pose and stimulus
    assert found[0] == 0
    assert found[-1] == count - 3
