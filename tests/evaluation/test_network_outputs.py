"""The adapter from networks on disk to outputs, and which codes each cell is fed."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import UnshearNet
from jaxunshear.config.registry import ALL_NETWORKS, NETWORKS
from jaxunshear.config.targets import list_target_names, make_range_targets
from jaxunshear.errors import UserError
from jaxunshear.evaluation import network_outputs
from jaxunshear.evaluation.code_swaps import decode_cells
from jaxunshear.evaluation.score import BASELINES, CELLS, DIRECT_KIND, POSE_KINDS, TARGET_KIND
from jaxunshear.models import unshearnet
from jaxunshear.models.modality import IMAGES
from jaxunshear.training.trainer import get_compile_options

PAPER_KINDS = ("tap", "sheared", "entangled", "disentangled")
TARGETS = make_range_targets((), Ranges())
QUANTITIES = list_target_names(TARGETS)
NET = UnshearNet(size=32, widths=(4, 4), pose_channels=3, shear_channels=3)
init = jax.jit(unshearnet.init, static_argnums=0, compiler_options=get_compile_options())
swapped = jax.jit(decode_cells, static_argnums=0)


def images(count=2):
    return (np.random.default_rng(0).random((count, 32, 32, 1)) < 0.3).astype(np.uint8) * 255


def apart(variables, sheared):
    z_p, z_s = unshearnet.encode(NET, variables, sheared)
    return {
        "DC(z_p)": unshearnet.unshear(NET, variables, sheared),
        "DC(z_s)": jax.nn.sigmoid(unshearnet.decode_canonical(NET, variables, z_s)),
        "DS(z_p,z_s)": jax.nn.sigmoid(unshearnet.decode_sheared(NET, variables, z_p, z_s)),
        "DS(z_p,z_p)": jax.nn.sigmoid(unshearnet.decode_sheared(NET, variables, z_p, z_p)),
    }


def test_cells_are_fed_the_right_codes():
    # fresh kernels are so small that every image is grey; larger ones make the cells differ
    variables = jax.tree.map(lambda x: 20 * x, init(NET, jax.random.key(0)))
    sheared = images().astype(np.float32) / 255
    cells = swapped(NET, variables, sheared)
    assert set(cells) == set(CELLS)
    expected = jax.jit(apart)(variables, sheared)
    for cell in CELLS:
        np.testing.assert_allclose(cells[cell], expected[cell], atol=1e-5)
    for right, wrong in (("DC(z_p)", "DC(z_s)"), ("DS(z_p,z_s)", "DS(z_p,z_p)")):
        assert not np.allclose(cells[right], cells[wrong], atol=1e-3)


@pytest.mark.parametrize(
    ("shear_channels", "cells"), [(0, {"DC(z_p)"}), (2, {"DC(z_p)", "DS(z_p,z_s)"})]
)
def test_cells_that_cannot_be_drawn_are_left_out(shear_channels, cells):
    net = replace(NET, shear_channels=shear_channels)
    variables = init(net, jax.random.key(0))
    assert set(swapped(net, variables, images().astype(np.float32) / 255)) == cells


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
    assert set(outputs.poses) == {*POSE_KINDS} - {TARGET_KIND}
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
