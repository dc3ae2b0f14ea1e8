"""The compiled form of a kernel's gradient: against the plain one in double precision, and without a compiler."""

import os
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.models.fast import compiled_kernels, conv

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
    x = np.pad(
        rng.normal(size=(images, h, w, c)).astype(np.float32),
        ((0, 0), (border, border), (border, border), (0, 0)),
    )
    dy = rng.normal(size=(images, x.shape[1] - k + 1, x.shape[2] - k + 1, n)).astype(np.float32)
    return x, dy


def by_definition(x, dy, k):
    x, dy = np.float64(x), np.float64(dy)
    h, w = dy.shape[1:3]
    places = [[x[:, i : i + h, j : j + w] for j in range(k)] for i in range(k)]
    return np.stack(
        [[np.tensordot(place, dy, ((0, 1, 2), (0, 1, 2))) for place in row] for row in places]
    )


@compiled
@pytest.mark.parametrize("case", CASES, ids=str)
def test_it_is_the_sum_it_says(case):
    k, border = case[:2]
    x, dy = arrays(*case)
    expected = by_definition(x, dy, k)
    for run in (
        compiled_kernels.kernel_gradient,
        jax.jit(compiled_kernels.kernel_gradient, static_argnums=(2, 3)),
    ):
        np.testing.assert_allclose(
            run(x, dy, k, border), expected, atol=2e-6 * np.abs(expected).max(), rtol=0
        )


@compiled
def test_the_network_takes_it_and_twice_gives_the_same_bits():
    x, dy = arrays(2, 1, 24, 64, 5, 17, 16)
    w = jnp.ones((2, 2, 24, 64), jnp.float32)
    grad = jax.jit(lambda w: jax.vjp(lambda w: conv.conv_valid(x, w, 1), w)[1](dy)[0])
    assert compiled_kernels.NAMES["KernelGradient"] in grad.lower(w).as_text()
    first = grad(w)
    for _ in range(10):
        np.testing.assert_array_equal(grad(w), first)
    for form in ("xla", "counted"):
        with compiled_kernels.use_form(form):
            other = jax.jit(lambda w: jax.vjp(lambda w: conv.conv_valid(x, w, 1), w)[1](dy)[0])
            assert compiled_kernels.NAMES["KernelGradient"] not in other.lower(w).as_text()
            np.testing.assert_allclose(other(w), first, atol=1e-5 * np.abs(first).max(), rtol=0)


@compiled
def test_mapped_over_it_is_as_one_by_one():
    x, dy = (array.reshape(3, 2, *array.shape[1:]) for array in arrays(2, 0, 5, 16, 6, 6, 5))
    run = lambda x, dy: compiled_kernels.kernel_gradient(x, dy, 2, 0)  # noqa: E731
    np.testing.assert_array_equal(
        jax.vmap(run)(x, dy), np.stack([run(a, b) for a, b in zip(x, dy, strict=True)])
    )


@compiled
def test_what_is_not_finite_is_passed_on():
    x, dy = arrays(2, 0, 8, 16, 2, 6, 5)
    x[0, 3, 2, 1] = np.nan
    found = np.isnan(compiled_kernels.kernel_gradient(x, dy, 2, 0))
    assert found[:, :, 1].all() and found.sum() == 4 * 16


@pytest.mark.parametrize("kind", [jnp.float64, jnp.bfloat16])
def test_other_numbers_and_few_channels_are_left_to_xla(kind):
    with jax.enable_x64(True):
        assert not compiled_kernels.can_compute_gradient(
            jnp.zeros((1, 3, 3, 16), kind), jnp.zeros((1, 2, 2, 16), kind)
        )
    few = jnp.zeros((1, 3, 3, 15)), jnp.zeros((1, 2, 2, 3))
    assert not compiled_kernels.can_compute_gradient(*few)
    with pytest.raises(ValueError, match="15 and 3 channels"):
        compiled_kernels.kernel_gradient(*few, 2, 0)


def reported(
    environment, code="print(compiled_kernels.is_available(), compiled_kernels.is_available())"
) -> tuple[str, str]:
    """What a process of its own says: whether there is a compiled form (in haste, not optimised), and its notes."""
    environment = {**os.environ, "PYTHONWARNINGS": "always", **environment}
    command = [
        sys.executable,
        "-c",
        f"from jaxunshear.models.fast import compiled_kernels; compiled_kernels.FLAGS += ('-O0',); {code}",
    ]
    process = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert process.returncode == 0, process.stderr
    return process.stdout.split()[0], process.stderr


@compiled
def test_it_is_compiled_once_and_kept_until_it_is_damaged(tmp_path):
    """By the compiler once; what it made is handed out when it is asked again."""
    folder, script, made = tmp_path / "cache", tmp_path / "compiler", tmp_path / "made"
    folder.mkdir()
    real = os.environ.get("CXX") or "c++"
    again = f'for out; do :; done; if [ -f "{made}" ]; then cp "{made}" "$out"; else {real} "$@" && cp "$out" "{made}"; fi'
    script.write_text(f'#!/bin/sh\ncase "$*" in *-dM*) exec {real} "$@";; esac\n{again}\n')
    script.chmod(0o755)
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
    for name, rest in (
        ("probe", "exit 0"),
        ("broken", "echo no member named x: an error >&2; exit 1"),
    ):
        (tmp_path / name).write_text(
            f'#!/bin/sh\ncase "$*" in *-dM*) echo a macro; exit 0;; esac\n{rest}\n'
        )
        (tmp_path / name).chmod(0o755)
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
    plain = slope(
        lambda x, w: jax.lax.conv_general_dilated(
            x, w, (1, 1), 2 * [(1, 1)], dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
    )
    for got, expected in zip(ours, plain, strict=True):
        np.testing.assert_allclose(
            got, expected, atol=1e-5 * float(jnp.abs(expected).max()), rtol=0
        )
