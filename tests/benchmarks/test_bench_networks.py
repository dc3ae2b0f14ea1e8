"""Benchmarks of networks: rows, counted multiplications, and a PyTorch twin that agrees."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import bench_networks
from benchmarks.multiplications import count_multiplications, count_posenet_multiplications
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.training import Training
from jaxunshear.errors import UserError
from jaxunshear.models import posenet, unshearnet
from jaxunshear.training.step import compute_regularisation
from jaxunshear.training.tasks import make_unshear_task

POSENET = PoseNet(size=32, widths=(4, 5, 6, 7, 8), hidden=9)
SMALL = UnshearNet(size=32, widths=(4, 6, 8), pose_channels=5, shear_channels=3)


@pytest.mark.parametrize("net", [SMALL, dataclasses.replace(SMALL, disentangled=False)])
@pytest.mark.parametrize("training", [True, False])
def test_multiplications_are_those_of_plain_convolutions(net, training):
    """Compare with the shapes of parameters, each used on the coarser of its two grids."""
    params = jax.eval_shape(lambda: unshearnet.init(net, jax.random.key(0)))["params"]
    side, expected = net.size, 0
    for i in range(len(net.widths)):
        side //= 2
        name = "First_0" if i == 0 else f"Down_{i - 1}"
        expected += params["E"][name]["kernel"].size * side**2
    codes = ["pose"] + (["shear"] if training else []) if net.disentangled else []
    expected += sum(params[name]["kernel"].size * side**2 for name in codes)
    for decoder in ["DC"] + (["DS"] if net.disentangled and training else []):
        names = [f"Up_{i}" for i in range(len(net.widths) - 1)] + ["Last_0"]
        expected += sum(
            params[decoder][name]["kernel"].size * (side * 2**i) ** 2
            for i, name in enumerate(names)
        )
    assert count_multiplications(net, training) == expected


def test_posenet_s_multiplications_are_those_of_its_layers():
    params = jax.eval_shape(lambda: posenet.init(POSENET, 5, jax.random.key(0)))["params"]
    places = {
        "First_0": 16,
        "Down_0": 8,
        "Same_0": 4,
        "Same_1": 4,
        "Same_2": 2,
        "Dense_0": 1,
        "Dense_1": 1,
    }
    expected = sum(params[name]["kernel"].size * side**2 for name, side in places.items())
    assert count_posenet_multiplications(POSENET) == expected


@pytest.mark.parametrize(
    "bench",
    [
        pytest.param(lambda: bench_networks.bench_train(32, 2, (1, 0.0)), marks=pytest.mark.long),
        lambda: bench_networks.bench_infer(32, 2, (1, 0.0)),
        lambda: bench_networks.bench_stream(32, (1, 0.0)),
    ],
    ids=["train", "infer", "stream"],
)
def test_rows(bench, monkeypatch):
    for name, net in (
        ("UnshearNet", SMALL),
        ("PoseNet", POSENET),
    ):  # the default widths take long to compile
        monkeypatch.setattr(bench_networks, name, functools.partial(dataclasses.replace, net))
    rows = bench()
    ours = rows[0]
    assert ours["name"] == "jaxunshear" and ours["images_per_s"] > 0 and ours["share"] > 0
    assert ours["images_per_s"] == pytest.approx(1e3 / ours["ms_per_image"])
    for row in rows[1:]:
        others = row["name"].startswith("pytorch") or row["name"] == "onnxruntime"
        forms = ("jaxunshear, XLA alone", "jaxunshear, plain layers")
        assert others or (row["name"] in forms and not row["failed"])
        assert row["failed"].count("is not installed") or row["images_per_s"] > 0
    assert "jaxunshear" in bench_networks.format_table(rows)


def test_what_is_not_installed_has_not_failed():
    def absent():
        raise ModuleNotFoundError(name="torch")

    def broken():
        raise RuntimeError("no")

    sides = iter(
        [("jaxunshear", lambda: lambda: None), ("pytorch", absent), ("pytorch, other", broken)]
    )
    said = bench_networks.format_table(bench_networks._compare_sides(sides, 32, 1, 1, (1, 0.0)))
    assert (
        "torch is not installed" in said
        and said.count("FAILED") == 1
        and "FAILED: RuntimeError: no" in said
    )


@pytest.mark.parametrize(("size", "batch"), [(100, 1), (128, 0)])
def test_what_cannot_be_measured_is_refused(size, batch):
    with pytest.raises(UserError, match=rf"size = {size}:|--batch {batch}:"):
        bench_networks.bench_train(size, batch)


@pytest.mark.parametrize("net", [SMALL, dataclasses.replace(SMALL, disentangled=False)])
def test_the_twin_computes_the_same(net):
    torch = pytest.importorskip("torch", reason="the extra `torch` is not installed")
    from benchmarks import torch_networks

    variables = unshearnet.init(net, jax.random.key(0))
    twin = torch_networks.TorchUnshearNet(net)
    twin.load(variables)
    canonical, sheared = (
        np.random.default_rng(0).integers(0, 2, (2, 3, 32, 32, 1)).astype(np.float32)
    )
    theirs = [torch.from_numpy(x.transpose(0, 3, 1, 2).copy()) for x in (canonical, sheared)]
    twin.eval()
    with torch.no_grad():
        out = twin.unshear(theirs[1]).numpy()[:, 0]
    np.testing.assert_allclose(
        out, unshearnet.unshear(net, variables, jnp.asarray(sheared))[..., 0], atol=1e-5
    )

    training = Training(l1=1e-4, l2=1e-3, losses={"supervised": 1.0, "reconstruction": 0.5})
    task = make_unshear_task(net, training)

    def loss(params):
        full = {"params": params, "batch_stats": variables["batch_stats"]}
        terms, _ = task.terms(full, {"canonical": canonical, "sheared": sheared}, jax.random.key(0))
        return sum(
            task.weights[k] * jnp.mean(v) for k, v in terms.items()
        ) + compute_regularisation(params, 1e-4, 1e-3)

    value, slopes = jax.value_and_grad(loss)(variables["params"])
    twin.train()
    with torch.no_grad():
        means = torch_networks.compute_losses(
            twin, dataclasses.replace(training, kernels="mean"), *theirs
        )
    params = variables["params"]
    heavier = compute_regularisation(params, 1e-4, 1e-3) - compute_regularisation(
        params, 1e-4, 1e-3, "mean"
    )
    assert float(means) == pytest.approx(float(value - heavier), rel=1e-4)
    found = torch_networks.compute_losses(twin, training, *theirs)
    found.backward()
    assert float(found.detach()) == pytest.approx(float(value), rel=1e-5)
    first = twin.E[0][0].weight.grad.numpy().transpose(2, 3, 1, 0)
    last = twin.DC[-1].weight.grad.numpy().transpose(2, 3, 0, 1)[::-1, ::-1]
    np.testing.assert_allclose(first, slopes["E"]["First_0"]["kernel"], rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(last, slopes["DC"]["Last_0"]["kernel"], rtol=1e-3, atol=1e-6)


def test_posenet_s_twin_computes_the_same():
    torch = pytest.importorskip("torch", reason="the extra `torch` is not installed")
    from benchmarks import torch_networks

    variables = posenet.init(POSENET, 5, jax.random.key(0))
    images = np.random.default_rng(0).random((3, 32, 32, 1)).astype(np.float32)
    twin = torch_networks.TorchPoseNet(POSENET, 5).eval()
    twin.load(variables)
    with torch.no_grad():
        theirs = twin(torch.from_numpy(images.transpose(0, 3, 1, 2).copy())).numpy()
    np.testing.assert_allclose(
        theirs, posenet.predict(POSENET, variables, jnp.asarray(images)), atol=1e-5
    )
