"""The adapter from networks on disk to outputs."""

import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import ALL_NETWORKS, NETWORKS
from jaxunshear.config.targets import list_target_names, make_range_targets
from jaxunshear.errors import UserError
from jaxunshear.evaluation import network_outputs
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
        assert {name: value.shape for name, value in outputs.poses[kind].items()} == dict.fromkeys(
            QUANTITIES, (2,)
        )
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
    assert {name.split("/")[1] for name in scores if name.startswith("ms_ssim")} == {
        *outputs.images
    } - {"tap"}
    # a PoseNet that learnt from sheared images is given those, with ranges of its own
    same, _ = network_outputs.load_run(trained, ("posenet", "posenet_sheared"), IMAGES)(
        images(), images()
    )
    twice = np.asarray(same.poses[DIRECT_KIND]["x_mm"])
    np.testing.assert_allclose(twice, 2 * np.asarray(same.poses["sheared"]["x_mm"]), rtol=1e-5)


def test_only_what_is_evaluated_is_read_and_run(trained, tmp_path):
    (tmp_path / "entangled").symlink_to(trained / "entangled")
    outputs, scores = network_outputs.load_run(tmp_path, ("entangled",), IMAGES)(images(), images())
    assert set(outputs.images) == {"tap", "sheared", "entangled"}
    assert (outputs.cells, outputs.poses) == ({}, {})
    assert set(scores) == {"ms_ssim/sheared", "ms_ssim/entangled"}
