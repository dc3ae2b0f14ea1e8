"""Networks on disk that have learnt nothing."""

from dataclasses import asdict, replace
from functools import partial

import jax
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PoseNet, UNet, UnshearNet
from jaxunshear.config.targets import make_range_targets, to_json
from jaxunshear.files import write_json
from jaxunshear.models import posenet, unet, unshearnet
from jaxunshear.training import checkpoint
from jaxunshear.training.trainer import get_compile_options


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Write the folder of a run with all networks at 32 px.

    Of the two PoseNets, one learnt poses from twice the lateral range.
    """
    folder = tmp_path_factory.mktemp("run")
    net = UnshearNet(size=32, widths=(4, 4), pose_channels=3, shear_channels=3)
    pose_net = PoseNet(size=32, widths=(4, 4, 4, 4, 4), hidden=8)
    entangled = replace(net, disentangled=False)
    nets = {
        "disentangled": ("unshear", unshearnet.init, net),
        "entangled": ("unshear", unshearnet.init, entangled),
        "entangled_large": ("unshear", unshearnet.init, replace(entangled, widths=(8, 8))),
        "unet": ("unet", unet.init, UNet(size=32, widths=(4, 4, 4))),
        "posenet": ("posenet", partial(posenet.init, outputs=5), pose_net),
        "posenet_sheared": ("posenet", partial(posenet.init, outputs=5), pose_net),
    }
    for name, (kind, init, settings) in nets.items():
        compiled = jax.jit(partial(init, settings), compiler_options=get_compile_options())
        variables = compiled(key=jax.random.key(0))
        variables = variables | {"params": jax.tree.map(lambda x: 10 * x, variables["params"])}
        ranges = Ranges(lateral_mm=10) if name == "posenet_sheared" else Ranges()
        targets = to_json(make_range_targets((), ranges))
        model = {"kind": kind, "net": asdict(settings), "targets": targets}
        checkpoint.write_settings(folder / name, model)
        checkpoint.save(folder / name, 1, {"average": variables}, {"best_step": 1, "history": []})
        write_json(folder / name / "summary.json", {"steps": 1})
    return folder
