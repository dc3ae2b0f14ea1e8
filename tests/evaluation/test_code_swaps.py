"""Spoilt codes: what goes where, and a network whose decoders need what they are fed."""

import shutil
from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import UnshearNet
from jaxunshear.errors import UserError
from jaxunshear.evaluation.code_swaps import (
    SWAP_CELLS,
    ablate,
    build_rows,
    decode_cells,
    format_table,
)
from jaxunshear.evaluation.score import score_cells
from jaxunshear.models import unshearnet
from jaxunshear.training.checkpoint import save, write_settings, write_weights
from jaxunshear.training.trainer import get_compile_options

init = jax.jit(unshearnet.init, static_argnums=0, compiler_options=get_compile_options())
NET = UnshearNet(size=32, widths=(4, 4), pose_channels=3, shear_channels=3)


@pytest.fixture(scope="module")
def drawn():
    variables = jax.tree.map(lambda x: 20 * x, init(NET, jax.random.key(0)))
    sheared = (np.random.default_rng(0).random((4, 32, 32, 1)) < 0.3).astype(np.float32)
    images = decode_cells(NET, variables, sheared, SWAP_CELLS, jnp.asarray(sheared[::-1]))
    return variables, sheared, images


def test_every_cell_is_drawn_from_its_codes(drawn):
    variables, sheared, images = drawn
    z_p, z_s = unshearnet.encode(NET, variables, sheared)
    blank = jnp.zeros_like(z_p)
    codes = {
        "DC(z_p)": (z_p,),
        "DC(z_s)": (z_s,),
        "DS(z_p,z_s)": (z_p, z_s),
        "DS(z_p,z_p)": (z_p, z_p),
        "DS(z_p,0)": (z_p, blank),
        "DS(0,z_s)": (blank, z_s),
        "DS(z_p,z_s of another)": (z_p, z_s[::-1]),
    }
    assert set(images) == set(SWAP_CELLS) == set(codes)
    for cell, given in codes.items():
        decode = unshearnet.decode_canonical if len(given) == 1 else unshearnet.decode_sheared
        logits = decode(NET, variables, *given)
        np.testing.assert_allclose(images[cell], jax.nn.sigmoid(logits), atol=1e-5)
    for right, wrong in (("DC(z_p)", "DC(z_s)"), ("DS(z_p,z_s)", "DS(z_p,z_p)")):
        assert not np.allclose(images[right], images[wrong], atol=1e-3)


@pytest.mark.parametrize(
    ("shear_channels", "lacking"),
    [(2, {"DC(z_s)", "DS(z_p,z_p)"}), (0, set(SWAP_CELLS) - {"DC(z_p)"})],
)
def test_cells_that_cannot_be_drawn_are_left_out(shear_channels, lacking):
    net = replace(NET, shear_channels=shear_channels)
    variables = init(net, jax.random.key(0))
    found = decode_cells(net, variables, jnp.zeros((2, 32, 32, 1)), SWAP_CELLS)
    assert set(SWAP_CELLS) - set(found) == lacking


def test_rows_give_which_image_was_drawn(drawn):
    _, sheared, images = drawn
    tap = jnp.asarray(sheared[[1, 0, 3, 2]])
    # a decoder that draws the image whose shear code it got
    perfect = {"DS(z_p,z_s of another)": sheared[::-1], "DS(z_p,z_s)": sheared}

    def enlarge(images):  # MS-SSIM needs more pixels
        return jnp.repeat(jnp.repeat(jnp.asarray(images), 4, axis=1), 4, axis=2)

    targets = {"tap": enlarge(tap), "sheared": enlarge(sheared)}
    scores = score_cells(jax.tree.map(enlarge, perfect), targets, enlarge(sheared[::-1]))
    rows = {row["name"]: row for row in build_rows(jax.device_get(scores), np.arange(4))}
    foreign, own = rows["DS(z_p,z_s of another)"], rows["DS(z_p,z_s)"]
    assert own["mse"] == 0 and own["ssim"] == pytest.approx(1, abs=1e-5)
    assert foreign["mse to the other"] == 0 and foreign["ssim"] < 0.5 < foreign["ssim to the other"]
    assert own["paper"]["mse"] == 0.002 and foreign["paper"] is None
    assert "DS(z_p,z_s of another)" in format_table(list(rows.values()))


def test_what_is_beside_the_papers_figure_is_multi_scale():
    """As the paper's is: by a single scale the same image scores 0.115."""
    scores = {"mse": 0.19, "ssim": 0.115, "ms_ssim": 0.165}
    scores = {f"swap/DC(z_s)/{name}": np.full(4, value) for name, value in scores.items()}
    rows = build_rows(scores, np.arange(4))
    line = format_table(rows).splitlines()[1]
    assert line.split()[2:] == ["0.1900", "0.165", "[0.165,", "0.165]", "-", "0.22,", "0.02"]


def test_networks_that_cannot_be_ablated_are_refused_by_name(tmp_path):
    """Half trained ones, and released weights, which lack DS."""
    variables, folder = init(NET, jax.random.key(0)), tmp_path / "disentangled"
    write_settings(folder, {"kind": "unshear", "net": asdict(NET)})
    save(folder, 1, {"average": variables}, {"best_step": 1, "history": []})
    with pytest.raises(UserError, match=r"disentangled was not finished: .*--network disentangled"):
        ablate(Experiment(name="x", claim="none"), tmp_path, tmp_path, "none")
    shutil.rmtree(folder)
    write_settings(folder, {"kind": "unshear", "net": asdict(NET)})
    write_weights(folder, variables, ("E", "pose", "DC"))
    with pytest.raises(UserError, match="leave out DS: name the folder of a finished run"):
        ablate(Experiment(name="x", claim="none"), tmp_path, tmp_path, "none")
