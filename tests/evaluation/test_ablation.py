"""Spoilt codes: what goes where, and a network whose decoders need what they are fed."""

from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.errors import UserError
from jaxunshear.evaluation.ablation import ablate, cell_scores, partners, picture, rows_of, table
from jaxunshear.evaluation.cells import SPOILT, draw_cells, target_of
from jaxunshear.experiment import Experiment
from jaxunshear.model import unshearnet
from jaxunshear.model.settings import UnshearNet
from jaxunshear.training.checkpoint import write_settings, write_weights
from jaxunshear.training.loop import run_once

init = jax.jit(unshearnet.init, static_argnums=0, compiler_options=run_once())
NET = UnshearNet(size=32, widths=(4, 4), pose_channels=3, shear_channels=3)


@pytest.fixture(scope="module")
def drawn():
    variables = jax.tree.map(lambda x: 20 * x, init(NET, jax.random.key(0)))
    sheared = (np.random.default_rng(0).random((4, 32, 32, 1)) < 0.3).astype(np.float32)
    return variables, sheared, draw_cells(NET, variables, sheared, SPOILT, jax.random.key(1))


def test_every_cell_is_drawn_from_its_codes(drawn):
    variables, sheared, images = drawn
    assert set(images) == set(SPOILT)
    z_p, z_s = unshearnet.encode(NET, variables, sheared)
    blank, further = jnp.zeros_like(z_p), [2, 3, 0, 1]
    for cell, logits in {
        "DC(0)": unshearnet.decode_canonical(NET, variables, blank),
        "DC(z_p of another)": unshearnet.decode_canonical(NET, variables, z_p[jnp.array(further)]),
        "DS(z_p,0)": unshearnet.decode_sheared(NET, variables, z_p, blank),
        "DS(z_p of another,z_s)": unshearnet.decode_sheared(NET, variables, z_p[jnp.array(further)], z_s),
    }.items():
        np.testing.assert_allclose(images[cell], jax.nn.sigmoid(logits), atol=1e-5)
    shuffled = images["DC(shuffled z_p)"]
    assert not np.allclose(shuffled, images["DC(z_p)"], atol=1e-3)
    again = draw_cells(NET, variables, sheared, SPOILT, jax.random.key(1))["DC(shuffled z_p)"]
    np.testing.assert_array_equal(shuffled, again)


def test_codes_of_two_widths_cannot_change_places():
    net = replace(NET, shear_channels=2)
    variables = init(net, jax.random.key(0))
    found = draw_cells(net, variables, jnp.zeros((2, 32, 32, 1)), SPOILT)
    assert set(SPOILT) - set(found) == {"DC(z_s)", "DS(z_p,z_p)", "DS(z_s,z_s)"}


def test_rows_tell_which_image_was_drawn(drawn):
    _, sheared, images = drawn
    tap = jnp.asarray(sheared[::-1])
    # a decoder that draws the image whose shear code it got
    perfect = {"DS(z_p,z_s of another)": jnp.roll(jnp.asarray(sheared), 2, axis=0), "DS(z_p,z_s)": jnp.asarray(sheared)}
    big = lambda x: jnp.repeat(jnp.repeat(x, 4, axis=1), 4, axis=2)  # noqa: E731  MS-SSIM wants more pixels
    scores = cell_scores(jax.tree.map(big, perfect), big(tap), big(jnp.asarray(sheared)))
    rows = {row["name"]: row for row in rows_of({k: np.asarray(v) for k, v in scores.items()}, np.arange(4))}
    foreign, own = rows["DS(z_p,z_s of another)"], rows["DS(z_p,z_s)"]
    assert own["mse"] == 0 and own["ssim"] == pytest.approx(1, abs=1e-5)
    assert foreign["mse to the other"] == 0 and foreign["ssim"] < 0.5 < foreign["ssim to the other"]
    assert own["paper"]["mse"] == 0.002 and foreign["paper"] is None
    assert "DS(z_p,z_s of another)" in table(list(rows.values()))


@pytest.mark.parametrize("total", [1, 2, 5, 32, 48, 49, 720])
def test_every_row_counts_once_beside_one_half_the_split_on(total):
    parts = list(partners(total, 32))
    assert len({rows.shape for rows, _ in parts}) == 1
    assert sorted(np.concatenate([rows[counts] for rows, counts in parts])) == list(range(total))
    for rows, counts in parts:
        apart = np.abs(rows - np.roll(rows, len(rows) // 2))[counts]
        assert np.all(apart >= total // 2) and np.all(apart <= (total + 1) // 2)


def test_released_weights_cannot_be_ablated(tmp_path):
    variables = init(NET, jax.random.key(0))
    folder = tmp_path / "disentangled"
    write_settings(folder, {"kind": "unshear", "net": asdict(NET)})
    write_weights(folder, variables, ("E", "pose", "DC"))
    with pytest.raises(UserError, match="leave out DS: name the folder of a finished run"):
        ablate(Experiment(name="x", claim="none"), tmp_path, tmp_path, "none")


def test_targets():
    assert {target_of(cell) for cell in SPOILT if cell.startswith("DS")} == {"sheared"}
    assert {target_of(cell) for cell in SPOILT if cell.startswith("DC")} == {"tap"}


def test_the_picture_is_one(drawn):
    assert picture({name: image[..., 0] for name, image in drawn[2].items()}).startswith(b"\x89PNG")
