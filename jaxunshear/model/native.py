"""The kernel's gradient on a CPU, compiled for the processor at hand (`kernel_gradient.cc`).

The first training on a machine compiles it, in about 3 s, with the C++ compiler ($CXX, or c++) and the headers that JAX brings, and
keeps it in the cache folder. Without a compiler, or with CXX=none, `conv.py` takes XLA's products, which are as exact, and slower.
"""

import contextlib
import contextvars
import ctypes
import functools
import hashlib
import os
import shlex
import shutil
import subprocess
import threading
import uuid
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax import Array

from jaxunshear.errors import first_line
from jaxunshear.storage import cache_folder

SOURCE = Path(__file__).with_name("kernel_gradient.cc")
NAME = "jaxunshear_kernel_gradient"
WIDEST = 16  # floats of a vector, at most
FLAGS = ("-std=c++17", "-O3", "-march=native", "-fPIC", "-shared", "-w")
SECONDS = 300  # that compiling may take
_once = threading.Lock()
_left_out = contextvars.ContextVar("left_out", default=False)


def suits(x: Array, dy: Array) -> bool:
    """Whether `kernel_gradient` takes these arrays, here: of float32, one of them with a vector of channels, on a CPU with a compiler."""
    floats = x.dtype == dy.dtype == jnp.float32 and max(x.shape[-1], dy.shape[-1]) >= WIDEST
    return floats and jax.default_backend() == "cpu" and not _left_out.get() and available()


@contextlib.contextmanager
def left_out() -> Iterator[None]:
    """What is traced herein takes XLA's products, whose operations XLA can count."""
    token = _left_out.set(True)
    try:
        yield
    finally:
        _left_out.reset(token)


def kernel_gradient(x: Array, dy: Array, k: int, border: int) -> Array:
    """dw (k, k, C, N) of `conv.conv_valid`, of x (B, H, W, C) and dy (B, H-k+1, W-k+1, N). Where `suits` says so."""
    c, n = x.shape[-1], dy.shape[-1]
    shape = jax.ShapeDtypeStruct((k * k, min(c, n), max(c, n)), jnp.float32)
    call = jax.ffi.ffi_call(NAME, shape, vmap_method="sequential")
    sums = call(x, dy, k=np.int64(k), border=np.int64(border))
    return (sums if c <= n else sums.swapaxes(1, 2)).reshape(k, k, c, n)


def available() -> bool:
    """Whether the compiled form is there; the first call of a process looks for it, or makes it."""
    with _once:
        return _load()


@functools.cache
def _load() -> bool:
    compiler = shlex.split(os.environ.get("CXX") or "c++")
    if not shutil.which(compiler[0]):
        return False
    try:
        library = ctypes.CDLL(str(_compiled(compiler)))
        jax.ffi.register_ffi_target(NAME, jax.ffi.pycapsule(library.KernelGradient), platform="cpu")
    except (subprocess.SubprocessError, OSError) as error:
        said = (getattr(error, "stderr", None) or b"").decode(errors="replace").splitlines()
        reason = next((line for line in said if "error" in line), first_line(error))
        warnings.warn(
            f"training takes the slower form of kernels' gradients (CXX=none: no attempt): {reason}", stacklevel=2
        )
        return False
    return True


def _compiled(compiler: list[str]) -> Path:
    """The library for this source, compiler, processor and JAX, from the cache folder where it is there."""
    macros = _run([*compiler, "-march=native", "-dM", "-E", "-x", "c++", os.devnull])  # tell compiler and processor
    told = "\n".join([*compiler, *FLAGS, jaxlib.__version__]).encode()
    key = hashlib.sha256(SOURCE.read_bytes() + told + macros).hexdigest()[:16]
    path = cache_folder() / f"kernel_gradient-{key}.so"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{uuid.uuid4().hex}.so")
        try:
            _run([*compiler, *FLAGS, f"-I{jax.ffi.include_dir()}", str(SOURCE), "-o", str(part)])
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    return path


def _run(command: list[str]) -> bytes:
    return subprocess.run(command, check=True, capture_output=True, timeout=SECONDS).stdout
