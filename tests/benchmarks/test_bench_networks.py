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


ENTANGLED = dataclasses.replace(SMALL, disentangled=False)


@pytest.mark.parametrize("net", [SMALL, ENTANGLED])
@pytest.mark.parametrize("training", [True, False])
def test_multiplications_are_those_of_plain_convolutions(net, training):
    """Compare with the shapes of parameters, each used on the coarser of its two grids."""
    params = jax.eval_shape(lambda: unshearnet.init(net, jax.random.key(0)))["params"]
    depth = len(net.widths)
    side = net.size // 2**depth
    places = [("E", "First_0", depth - 1)]
    places += [("E", f"Down_{i}", depth - 2 - i) for i in range(depth - 1)]
    both = net.disentangled and training
    for decoder in ("DC", "DS") if both else ("DC",):
        places += [(decoder, f"Up_{i}", i) for i in range(depth - 1)]
        places.append((decoder, "Last_0", depth - 1))
    expected = sum(params[m][name]["kernel"].size * (side * 2**i) ** 2 for m, name, i in places)
    codes = ["pose", "shear"] if both else ["pose"] if net.disentangled else []
    expected += sum(params[name]["kernel"].size * side**2 for name in codes)
    assert count_multiplications(net, training) == expected


def test_posenet_s_multiplications_are_those_of_its_layers():
    params = jax.eval_shape(lambda: posenet.init(POSENET, 5, jax.random.key(0)))["params"]
    places = {"First_0": 16, "Down_0": 8, "Same_0": 4, "Same_1": 4, "Same_2": 2}
    places |= {"Dense_0": 1, "Dense_1": 1}
    expected = sum(params[name]["kernel"].size * side**2 for name, side in places.items())
    assert count_posenet_multiplications(POSENET) == expected


@pytest.mark.parametrize(
    "bench",
    [
        pytest.param(lambda: bench_networks.bench_train(32, 2, (1, 0.0)), marks=pytest.mark.long),
        lambda: bench_networks.bench_infer(32, 2, (1, 0.0)),
        lambda: bench_networks.bench_frame(32, (1, 0.0)),
    ],
    ids=["train", "infer", "stream"],
)
def test_rows(bench, monkeypatch):
    # the default widths take long to compile
    for name, net in (("UnshearNet", SMALL), ("PoseNet", POSENET)):
        monkeypatch.setattr(bench_networks, name, functools.partial(dataclasses.replace, net))
    ours, *others = bench()
    assert ours["name"] == "jaxunshear" and ours["images_per_s"] > 0 and ours["share"] > 0
    assert ours["images_per_s"] == pytest.approx(1e3 / ours["ms_per_image"])
    assert ours["ratio"] == 1
    for row in others:
        forms = ("jaxunshear, XLA alone", "jaxunshear, plain layers")
        is_other = row["name"].startswith("pytorch") or row["name"].endswith("onnxruntime")
        assert is_other or (row["name"] in forms and not row["failed"])
        assert row["failed"].count("is not installed") or row["images_per_s"] > 0
    assert "jaxunshear" in bench_networks.format_table([ours, *others])


def test_what_is_not_installed_has_not_failed():
    def fail(error):
        raise error

    absent = functools.partial(fail, ModuleNotFoundError(name="torch"))
    broken = functools.partial(fail, RuntimeError("no"))
    ours = ("jaxunshear", lambda: lambda: None)
    sides = iter([ours, ("pytorch", absent), ("pytorch, other", broken)])
    said = bench_networks.format_table(bench_networks._compare_sides(sides, 32, 1, 1, (1, 0.0)))
    assert "torch is not installed" in said
    assert said.count("FAILED") == 1 and "FAILED: RuntimeError: no" in said


@pytest.mark.parametrize(("size", "batch"), [(100, 1), (128, 0)])
def test_what_cannot_be_measured_is_refused(size, batch):
    with pytest.raises(UserError, match=rf"size = {size}:|--batch {batch}:"):
        bench_networks.bench_train(size, batch)


def to_torch(images):
    torch = pytest.importorskip("torch", reason="the extra `torch` is not installed")
    return torch.from_numpy(images.transpose(0, 3, 1, 2).copy())


@pytest.mark.parametrize("net", [SMALL, ENTANGLED])
def test_the_twin_computes_the_same(net):
    torch = pytest.importorskip("torch", reason="the extra `torch` is not installed")
    from benchmarks import torch_networks

    variables = unshearnet.init(net, jax.random.key(0))
    params = variables["params"]
    twin = torch_networks.TorchUnshearNet(net)
    twin.load(variables)
    images = np.random.default_rng(0).integers(0, 2, (2, 3, 32, 32, 1)).astype(np.float32)
    canonical, sheared = images
    theirs = [to_torch(each) for each in images]
    twin.eval()
    with torch.no_grad():
        out = twin.unshear(theirs[1]).numpy()[:, 0]
    expected = unshearnet.unshear(net, variables, jnp.asarray(sheared))
    np.testing.assert_allclose(out, expected[..., 0], atol=1e-5)

    training = Training(l1=1e-4, l2=1e-3, losses={"supervised": 1.0, "reconstruction": 0.5})
    task = make_unshear_task(net, training)

    def loss(params):
        batch = {"canonical": canonical, "sheared": sheared}
        terms, _ = task.terms(variables | {"params": params}, batch, jax.random.key(0))
        weighted = sum(task.weights[k] * jnp.mean(v) for k, v in terms.items())
        return weighted + compute_regularisation(params, 1e-4, 1e-3)

    value, slopes = jax.value_and_grad(loss)(params)
    twin.train()
    by_mean = dataclasses.replace(training, kernels="mean")
    with torch.no_grad():
        means = torch_networks.compute_losses(twin, by_mean, *theirs)
    by_sum, by_mean = (compute_regularisation(params, 1e-4, 1e-3, how) for how in ("sum", "mean"))
    assert float(means) == pytest.approx(float(value - by_sum + by_mean), rel=1e-4)
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
        theirs = twin(to_torch(images)).numpy()
    expected = posenet.predict(POSENET, variables, jnp.asarray(images))
    np.testing.assert_allclose(theirs, expected, atol=1e-5)
