"""The kernel's gradient on a CPU, compiled for the processor at hand (`kernel_gradient.cc`).

The first training on a machine compiles it, in about 3 s, with the C++ compiler ($CXX, or c++) and the headers that JAX brings, and
keeps it in the cache folder. Without a compiler, or with CXX=none, `conv.py` takes XLA's products, which are as exact, and slower.
"""

import contextlib
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
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax import Array

from jaxunshear.errors import Note, first_line
from jaxunshear.storage import cache_folder

SOURCE = Path(__file__).with_name("kernel_gradient.cc")
NAME = "jaxunshear_kernel_gradient"
WIDEST = 16  # floats of a vector, at most
FLAGS = ("-std=c++17", "-O3", "-march=native", "-fPIC", "-shared", "-w")
SECONDS = 300  # that compiling may take
_once = threading.Lock()


def suits(x: Array, dy: Array) -> bool:
    """Whether `kernel_gradient` takes these arrays, here: of float32, one of them with a vector of channels, on a CPU with a compiler."""
    floats = x.dtype == dy.dtype == jnp.float32
    return floats and max(x.shape[-1], dy.shape[-1]) >= WIDEST and available()


def kernel_gradient(x: Array, dy: Array, k: int, border: int) -> Array:
    """dw (k, k, C, N) of `conv.conv_valid`, of x (B, H, W, C) and dy (B, H-k+1, W-k+1, N). Where `suits` says so."""
    c, n = x.shape[-1], dy.shape[-1]
    if max(c, n) < WIDEST:
        raise ValueError(f"{c} and {n} channels: the larger must be at least {WIDEST}")
    shape = jax.ShapeDtypeStruct((k * k, min(c, n), max(c, n)), jnp.float32)
    call = jax.ffi.ffi_call(NAME, shape, vmap_method="sequential")
    sums = call(x, dy, k=np.int64(k), border=np.int64(border))
    return (sums if c <= n else sums.swapaxes(1, 2)).reshape(k, k, c, n)


def available() -> bool:
    """Whether JAX is on a CPU and the compiled form is there; the first call of a process looks for it, or makes it."""
    with _once:
        return jax.default_backend() == "cpu" and _load()


@functools.cache
def _load() -> bool:
    try:
        compiler = shlex.split(os.environ.get("CXX", "")) or ["c++"]
        if not shutil.which(compiler[0]):
            return False
        library = _library(compiler)
        jax.ffi.register_ffi_target(NAME, jax.ffi.pycapsule(library.KernelGradient), platform="cpu")
    except (subprocess.SubprocessError, OSError, ValueError, RuntimeError) as error:
        said = (getattr(error, "stderr", None) or b"").decode(errors="replace").splitlines()
        reason = next((line for line in said if "error" in line), first_line(error))
        warnings.warn(f"training takes its slower form (CXX=none: without this note): {reason}", Note, stacklevel=2)
        return False
    return True


def _library(compiler: list[str]) -> ctypes.CDLL:
    """For this source, compiler, processor, user and JAX, from the cache folder where it is there and whole."""
    macros = _run([*compiler, "-march=native", "-dM", "-E", "-x", "c++", os.devnull])  # tell compiler and processor
    told = "\n".join([*compiler, *FLAGS, jaxlib.__version__, str(getattr(os, "getuid", str)())]).encode()
    key = hashlib.sha256(SOURCE.read_bytes() + told + macros).hexdigest()[:16]
    path = cache_folder().absolute() / f"kernel_gradient-{key}.so"
    with contextlib.suppress(OSError):  # not there, or empty
        return ctypes.CDLL(str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{uuid.uuid4().hex}.so")
    try:
        _run([*compiler, *FLAGS, f"-I{jax.ffi.include_dir()}", str(SOURCE), "-o", str(part)])
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return ctypes.CDLL(str(path))


def _run(command: list[str]) -> bytes:
    return subprocess.run(command, check=True, capture_output=True, timeout=SECONDS).stdout
