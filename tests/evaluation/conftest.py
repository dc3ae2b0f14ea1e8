"""Networks on disk that have learnt nothing."""

from dataclasses import asdict, replace

import jax
import pytest

from jaxunshear.model import posenet, unet, unshearnet
from jaxunshear.model.settings import PoseNet, UNet, UnshearNet
from jaxunshear.storage import write_json
from jaxunshear.training import checkpoint
from jaxunshear.training.loop import run_once


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The folder of a run with all networks at 32 px."""
    folder = tmp_path_factory.mktemp("run")
    net = UnshearNet(size=32, widths=(4, 4), pose_channels=3, shear_channels=3)
    nets = {
        "disentangled": ("unshear", unshearnet, net),
        "entangled": ("unshear", unshearnet, replace(net, disentangled=False)),
        "entangled_large": ("unshear", unshearnet, replace(net, widths=(8, 8), disentangled=False)),
        "unet": ("unet", unet, UNet(size=32, widths=(4, 4, 4))),
        "posenet": ("posenet", posenet, PoseNet(size=32, widths=(4, 4, 4, 4, 4), hidden=8)),
        "posenet_sheared": ("posenet", posenet, PoseNet(size=32, widths=(4, 4, 4, 4, 4), hidden=8)),
    }
    for name, (kind, module, settings) in nets.items():
        variables = jax.jit(module.init, static_argnums=0, compiler_options=run_once())(settings, jax.random.key(0))
        variables = {"params": jax.tree.map(lambda x: 10 * x, variables["params"])} | {
            "batch_stats": variables["batch_stats"]
        }
        checkpoint.write_settings(folder / name, {"kind": kind, "net": asdict(settings)})
        checkpoint.save(folder / name, 1, {"average": variables}, {"best_step": 1, "history": []})
        write_json(folder / name / "summary.json", {"steps": 1})
    return folder
