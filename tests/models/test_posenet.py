"""PoseNet: shapes, units there and back, independence of the batch."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PoseNet
from jaxunshear.config.targets import count_outputs, make_range_targets
from jaxunshear.errors import UserError
from jaxunshear.models import posenet
from jaxunshear.training.trainer import get_compile_options

NET = PoseNet(size=32, widths=(4, 4, 4, 4, 4), hidden=8)
TARGETS = make_range_targets((), Ranges())


def test_targets_and_units_are_inverse():
    rng = np.random.default_rng(0)
    pose = jnp.asarray(rng.uniform(-1, 1, (50, 4)) * [5, 5, 45, 6], jnp.float32)
    edge = jnp.asarray(rng.uniform(-1, 1, (50, 2)) * [7, 179], jnp.float32)
    targets = posenet.scale_poses({"pose": pose, "edge": edge}, TARGETS)
    assert targets.shape == (50, 5)
    assert np.all((targets >= 0) & (targets <= 1))
    back = posenet.unscale_outputs(targets, TARGETS)
    true = {"x_mm": pose[:, 0], "yaw_deg": pose[:, 2]}
    true |= {"edge_mm": edge[:, 0], "edge_deg": edge[:, 1]}
    tolerances = {"yaw_deg": 1e-4, "edge_deg": 1e-3}
    for name, values in true.items():
        np.testing.assert_allclose(back[name], values, atol=tolerances.get(name, 1e-5))


def test_poses_are_drawn_evenly_over_ranges_and_circles():
    outputs = posenet.sample_outputs(TARGETS, 4000, jax.random.key(0))
    pose = posenet.unscale_outputs(outputs, TARGETS)
    for name, reach in (("x_mm", 5), ("yaw_deg", 45), ("edge_deg", 180)):
        quantiles = np.quantile(pose[name], [0.0, 0.25, 0.5, 0.75, 1.0]) / reach
        np.testing.assert_allclose(quantiles, [-1, -0.5, 0, 0.5, 1], atol=0.05)
    assert abs(np.corrcoef(pose["x_mm"], pose["yaw_deg"])[0, 1]) < 0.05


def test_the_papers_two_outputs_come_first():
    batch = {"pose": jnp.asarray([[5.0, 0, -45, 1]]), "edge": jnp.zeros((1, 2))}
    np.testing.assert_allclose(posenet.scale_poses(batch, TARGETS)[0, :2], [1, 0], atol=1e-6)


@pytest.mark.parametrize(("lateral_mm", "yaw_deg", "outputs"), [(0, 45, 3), (5, 0, 4)])
def test_a_range_of_zero_has_no_output_and_leaves_the_others_finite(lateral_mm, yaw_deg, outputs):
    varied = make_range_targets((), Ranges(lateral_mm=lateral_mm, yaw_deg=yaw_deg))
    targets = posenet.scale_poses({"pose": jnp.zeros((1, 4)), "edge": jnp.zeros((1, 2))}, varied)
    assert targets.shape == (1, outputs)
    assert np.all(np.isfinite(targets))


@pytest.mark.parametrize(
    "net", [NET, pytest.param(PoseNet(), marks=pytest.mark.long)], ids=["small", "demo"]
)
def test_outputs_lie_between_zero_and_one_and_do_not_depend_on_the_batch(net):
    init = jax.jit(posenet.init, static_argnums=(0, 1), compiler_options=get_compile_options())
    variables = init(net, count_outputs(TARGETS), jax.random.key(0))
    images = jax.random.uniform(jax.random.key(1), (3, net.size, net.size, 1))
    predict = jax.jit(lambda v, x: posenet.predict(net, v, x))
    outputs = predict(variables, images)
    assert outputs.shape == (3, 5)
    assert np.all((outputs > 0) & (outputs < 1))
    np.testing.assert_allclose(predict(variables, images[1:2])[0], outputs[1], atol=1e-6)
    trained, stats = jax.eval_shape(partial(posenet.predict_training, net), variables, images)
    assert trained.shape == (3, 5)
    assert jax.tree.structure(stats) == jax.tree.structure(variables["batch_stats"])


@pytest.mark.parametrize(
    ("net", "field"), [(PoseNet(size=100), "size"), (PoseNet(widths=(4, 4)), "widths")]
)
def test_sizes_that_do_not_fit_are_refused_by_name(net, field):
    with pytest.raises(UserError, match=field):
        posenet.init(net, 5, jax.random.key(0))
