"""The compiled form of a kernel's gradient: against the plain one in double precision, and without a compiler."""

import os
import re
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.models.fast import compiled_kernels, conv
from jaxunshear.models.fast.compiled_kernels import kernel_gradient
from tests.helpers.convolutions import check_close, convolve

compiled = pytest.mark.usefixtures("compiled")
# k, border, C, N, images, H, W: tails of rows and of vectors, either array the wider, borders of every kind, several slabs
CASES = [
    (1, 0, 3, 16, 3, 9, 7),
    (1, 0, 128, 36, 8, 33, 33),
    (2, 0, 17, 5, 3, 9, 7),
    (2, 0, 64, 128, 8, 17, 16),
    (1, 0, 8, 16, 11, 40, 30),  # images in groups that do not divide them
    (2, 1, 33, 40, 7, 9, 8),
    (3, 1, 70, 100, 2, 6, 6),
    (3, 2, 16, 16, 3, 7, 9),
    (4, 2, 6, 130, 3, 9, 7),
    (5, 0, 20, 7, 2, 5, 5),
    (3, 1, 16, 24, 2, 1, 1),  # shifts that nothing is left of
    (3, 1, 16, 8, 3, 1, 4),
]


def arrays(k, border, c, n, images, h, w):
    rng = np.random.default_rng(k + c + n)
    x = conv.pad(np.float32(rng.normal(size=(images, h, w, c))), border)
    dy = rng.normal(size=(images, x.shape[1] - k + 1, x.shape[2] - k + 1, n))
    return np.array(x), dy.astype(np.float32)


def by_definition(x, dy, k):
    x, dy = np.float64(x), np.float64(dy)
    h, w = dy.shape[1:3]
    places = [x[:, i : i + h, j : j + w] for i in range(k) for j in range(k)]
    found = [np.tensordot(place, dy, ((0, 1, 2), (0, 1, 2))) for place in places]
    return np.reshape(found, (k, k, x.shape[-1], dy.shape[-1]))


@compiled
@pytest.mark.parametrize("case", CASES, ids=str)
def test_it_is_the_sum_it_says(case):
    x, dy = arrays(*case)
    expected = by_definition(x, dy, case[0])
    for run in (kernel_gradient, jax.jit(kernel_gradient, static_argnums=(2, 3))):
        found = np.float64(run(x, dy, *case[:2]))
        check_close(found, expected, 2e-6)


@compiled
def test_the_network_takes_it_and_twice_gives_the_same_bits():
    x, dy = arrays(2, 1, 24, 64, 5, 17, 16)
    w = jnp.ones((2, 2, 24, 64), jnp.float32)

    def make_gradient():
        return jax.jit(lambda w: jax.vjp(lambda w: conv.conv_valid(x, w, 1), w)[1](dy)[0])

    grad, name = make_gradient(), compiled_kernels.NAMES["KernelGradient"]
    assert name in grad.lower(w).as_text()
    first = grad(w)
    for _ in range(10):
        np.testing.assert_array_equal(grad(w), first)
    for form in ("xla", "counted"):
        with compiled_kernels.use_form(form):
            other = make_gradient()
            assert name not in other.lower(w).as_text()
            check_close(other(w), first, 1e-5)


@compiled
def test_mapped_over_it_is_as_one_by_one():
    x, dy = (array.reshape(3, 2, *array.shape[1:]) for array in arrays(2, 0, 5, 16, 6, 6, 5))
    run = partial(kernel_gradient, k=2, border=0)
    one_by_one = np.stack([run(*each) for each in zip(x, dy, strict=True)])
    np.testing.assert_array_equal(jax.vmap(run)(x, dy), one_by_one)


@compiled
def test_what_is_not_finite_is_passed_on():
    x, dy = arrays(2, 0, 8, 16, 2, 6, 5)
    x[0, 3, 2, 1] = np.nan
    found = np.isnan(kernel_gradient(x, dy, 2, 0))
    assert found[:, :, 1].all() and found.sum() == 4 * 16


def test_other_numbers_and_few_channels_are_left_to_xla():
    for kind in (jnp.float64, jnp.bfloat16):
        with jax.enable_x64(True):
            wide = jnp.zeros((1, 3, 3, 16), kind), jnp.zeros((1, 2, 2, 16), kind)
            assert not compiled_kernels.can_compute_gradient(*wide)
    few = jnp.zeros((1, 3, 3, 15)), jnp.zeros((1, 2, 2, 3))
    assert not compiled_kernels.can_compute_gradient(*few)
    with pytest.raises(ValueError, match="15 and 3 channels"):
        kernel_gradient(*few, 2, 0)


AVAILABLE = "print(compiled_kernels.is_available(), compiled_kernels.is_available())"


def reported(environment, code=AVAILABLE) -> tuple[str, str]:
    """What a process of its own says: whether there is a compiled form (in haste, not optimised), and its notes."""
    environment = {**os.environ, "PYTHONWARNINGS": "always", **environment}
    start = (
        "from jaxunshear.models.fast import compiled_kernels; compiled_kernels.FLAGS += ('-O0',)"
    )
    command = [sys.executable, "-c", f"{start}; {code}"]
    process = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert process.returncode == 0, process.stderr
    return process.stdout.split()[0], process.stderr


def write_compiler(path, macros, rest):
    """Write a script that answers with `macros` if asked for them, and does the `rest` if not."""
    path.write_text(f'#!/bin/sh\ncase "$*" in *-dM*) {macros};; esac\n{rest}\n')
    path.chmod(0o755)


@compiled
def test_it_is_compiled_once_and_kept_until_it_is_damaged(tmp_path):
    """By the compiler once; what it made is handed out when it is asked again."""
    folder, script, made = tmp_path / "cache", tmp_path / "compiler", tmp_path / "made"
    folder.mkdir()
    real = os.environ.get("CXX") or "c++"
    write_compiler(
        script,
        f'exec {real} "$@"',
        f'for out; do :; done; if [ -f "{made}" ]; then cp "{made}" "$out"; '
        f'else {real} "$@" && cp "$out" "{made}"; fi',
    )
    cache = {"JAXUNSHEAR_CACHE": str(folder), "CXX": str(script)}
    assert reported(cache) == ("True", "")
    (kept,) = folder.iterdir()
    size, before = kept.stat().st_size, kept.stat().st_mtime_ns
    assert reported(cache) == ("True", "")
    assert [kept] == list(folder.iterdir()) and kept.stat().st_mtime_ns == before
    for damaged in (b"", kept.read_bytes()[:-1] + b"?"):
        kept.write_bytes(damaged)
        assert reported(cache) == ("True", "")
        assert [kept] == list(folder.iterdir()) and kept.stat().st_size == size
        assert kept.read_bytes() != damaged


@pytest.mark.long
@compiled
def test_any_number_of_threads_gives_the_same_bits(tmp_path):
    code = (
        "import hashlib, numpy as np; compiled_kernels.is_available(); rng = np.random.default_rng(0); "
        "x, dy = (rng.normal(size=(3, 20, side, c)).astype(np.float32) for side, c in ((19, 40), (18, 24))); "
        "print(hashlib.sha256(np.asarray(compiled_kernels.kernel_gradient(x, dy[:, 1:], 2, 0))).hexdigest())"
    )
    cache = {"JAXUNSHEAR_CACHE": str(tmp_path)}
    sums = {reported({**cache, "NPROC": threads}, code)[0] for threads in ("1", "2", "5", "60")}
    assert len(sums) == 1


def test_without_a_compiler_nothing_is_said(tmp_path):
    assert reported({"JAXUNSHEAR_CACHE": str(tmp_path), "CXX": "none-such"}) == ("False", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("cxx", "cache", "reason"),
    [
        ("false", "cache", "non-zero exit status"),
        ("'c++", "cache", "No closing quotation"),
        ("{folder}/broken", "cache", "no member named x: an error"),
        ("{folder}/probe", "file", "Not a directory|File exists"),
    ],
)
def test_what_hinders_it_is_reported_once(tmp_path, cxx, cache, reason):
    (tmp_path / "file").touch()
    fail = "echo no member named x: an error >&2; exit 1"
    for name, rest in (("probe", "exit 0"), ("broken", fail)):
        write_compiler(tmp_path / name, "echo a macro; exit 0", rest)
    environment = {"JAXUNSHEAR_CACHE": str(tmp_path / cache), "CXX": cxx.format(folder=tmp_path)}
    answer, said = reported(environment)
    assert answer == "False" and said.count("slower form") == 1 and re.search(reason, said)
    assert not list(tmp_path.rglob("*.so"))


def test_second_derivatives_are_those_of_the_plain_convolution():
    x, dy = arrays(2, 1, 16, 18, 2, 5, 6)
    w = jnp.asarray(np.random.default_rng(0).normal(size=(2, 2, 16, 18)), jnp.float32)

    def slope(convolution):
        inner = jax.grad(lambda w, x: jnp.sum(jnp.sin(convolution(x, w)) * dy))
        return jax.grad(lambda x, w: jnp.sum(inner(w, x) ** 2), (0, 1))(x[:, 1:-1, 1:-1], w)

    ours = slope(lambda x, w: conv.conv_valid(conv.pad(x, 1), w, 1))
    plain = slope(partial(convolve, padding=2 * [(1, 1)]))
    for got, expected in zip(ours, plain, strict=True):
        check_close(got, expected, 1e-5)
