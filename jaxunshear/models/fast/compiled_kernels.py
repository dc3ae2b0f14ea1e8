"""Kernels in C++ (`compiled/`) for training on a CPU, compiled for its processor.

These are the gradients of convolution kernels, the layers next to the image, and the normalisation.
The first training on a machine compiles them, in about 10 s, with the C++ compiler ($CXX, or c++)
and the headers that JAX brings, and keeps them in the cache folder. Without a compiler, or with
CXX=none, `conv.py`, `image_layers.py` and `norm.py` take XLA's forms, which are as exact, and
slower.
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

from jaxunshear.errors import Note, get_first_line
from jaxunshear.files import cache_folder

SOURCES = sorted(Path(__file__).with_name("compiled").glob("*.[ch]*"))
SYMBOLS = (
    "KernelGradient",
    "Gather",
    "Scatter",
    "Outer",
    "Moments",
    "AffineRelu",
    "Slopes",
    "Gradient",
)
NAMES = {symbol: f"jaxunshear_{symbol}" for symbol in SYMBOLS}
LAYOUTS = ("plain", "padded", "blocks")  # in the order of layouts.h
GROUPS = 8  # groups of images with a sum of their own, at most
SPREAD = 8  # floats read, at least, for each float of these sums
BAND = 16384  # floats, at most, of which moments and slopes are summed at once
WIDEST = 16  # floats of a vector, at most
FLAGS = ("-std=c++17", "-O3", "-march=native", "-fPIC", "-shared", "-w")
SECONDS = 300  # that compiling may take
_once = threading.Lock()
_form = contextvars.ContextVar("form", default="compiled")


@contextlib.contextmanager
def use_form(name: str) -> Iterator[None]:
    """Use a form in what is traced within this context.

    Forms are "compiled", the default; "xla", that of machines without a compiler; and "counted",
    whose operations XLA can count, slow on a CPU.
    """
    token = _form.set(name)
    try:
        yield
    finally:
        _form.reset(token)


def get_form() -> str:
    """Return the form to trace."""
    return _form.get()


def can_compute_gradient(x: Array, dy: Array) -> bool:
    """Return whether `kernel_gradient` takes these arrays on this machine.

    They must be float32, one of them with a full vector of channels.
    """
    are_floats = x.dtype == dy.dtype == jnp.float32
    return are_floats and max(x.shape[-1], dy.shape[-1]) >= WIDEST and is_available()


def kernel_gradient(x: Array, dy: Array, k: int, border: int) -> Array:
    """Compute dw (k, k, C, N) of `conv.conv_valid`, for x (B, H, W, C), dy (B, H-k+1, W-k+1, N).

    `can_compute_gradient` must be true.
    """
    c, n = x.shape[-1], dy.shape[-1]
    if max(c, n) < WIDEST:
        raise ValueError(f"{c} and {n} channels: the larger must be at least {WIDEST}")
    size, groups = k * k * c * n, 1  # of images
    while 2 * groups <= min(len(x), GROUPS) and SPREAD * 2 * groups * size <= x.size + dy.size:
        groups *= 2
    parts = _call(
        "KernelGradient", (groups, k * k, min(c, n), max(c, n)), x, dy, k=k, border=border
    )
    sums = parts.sum(0) if groups > 1 else parts[0]
    return (sums if c <= n else sums.swapaxes(1, 2)).reshape(k, k, c, n)


def can_compute_image(image: Array | jax.ShapeDtypeStruct, w: Array) -> bool:
    """Return whether `gather`, `scatter` and `outer` take an image and a kernel (4, 4, ...).

    They must be float32, with one channel in the image and full vectors in the kernel.
    """
    _, height, width, channels = image.shape
    return (
        height == width
        and height % 4 == 0
        and channels == 1
        and image.dtype == w.dtype == jnp.float32
        and w.shape[2] * w.shape[3] % WIDEST == 0
        and is_available()
    )


def gather(image: Array, kernel: Array) -> Array:
    b, side = image.shape[:2]
    return _call("Gather", (b, side // 4 + 1, side // 4 + 1, 4 * kernel.shape[1]), image, kernel)


def scatter(blocks: Array, kernel: Array) -> Array:
    b, rows = blocks.shape[:2]
    return _call("Scatter", (b, 4 * rows - 4, 4 * rows - 4, 1), blocks, kernel.T)


def outer(image: Array, blocks: Array) -> Array:
    return _call("Outer", (len(image), 16, blocks.shape[-1] // 4), image, blocks).sum(0)


def can_normalise(x: Array, *more: Array, source: str) -> bool:
    """Return whether the four passes of `norm.py` take these arrays on this machine.

    They must be float32, with full vectors of channels.
    """
    are_floats = all(array.dtype == jnp.float32 for array in (x, *more))
    channels = x.shape[-1] // 4 if source == "blocks" else x.shape[-1]
    return are_floats and channels % WIDEST == 0 and is_available()


def moments(x: Array, *, source: str) -> tuple[Array, Array]:
    """Compute mean and variance of bands of rows, then of all.

    A band stays in the cache for the deviations from its own mean.
    """
    parts = _call("Moments", _compute_band_shape(x, source), x, source=source)
    mean = jnp.mean(parts[:, 0], 0)
    return mean, jnp.mean(parts[:, 1] + (parts[:, 0] - mean[None]) ** 2, 0)


def affine_relu(x: Array, factor: Array, shift: Array, *, source: str, target: str) -> Array:
    shape = _convert_shape(x.shape, source, target)
    return _call("AffineRelu", shape, x, factor, shift, source=source, target=target)


def slopes(
    x: Array, dy: Array, factor: Array, shift: Array, mean: Array, *, source: str, target: str
) -> tuple[Array, Array]:
    shape, arrays = _compute_band_shape(x, source), (x, dy, factor, shift, mean)
    sums = jnp.sum(_call("Slopes", shape, *arrays, source=source, target=target), 0)
    return sums[0], sums[1]


def gradient(x: Array, *more: Array, source: str, target: str) -> Array:
    return _call("Gradient", x.shape, x, *more, source=source, target=target)


def _convert_shape(shape: tuple[int, ...], source: str, target: str) -> tuple[int, ...]:
    """Compute the shape of an image in another layout."""
    b, h, w, c = shape
    rows, columns, channels = (2 * h - 2, 2 * w - 2, c // 4) if source == "blocks" else (h, w, c)
    blocks = (b, rows // 2 + 1, columns // 2 + 1, 4 * channels)
    return {
        "plain": (b, rows, columns, channels),
        "padded": (b, rows + 2, columns + 2, channels),
        "blocks": blocks,
    }[target]


def _compute_band_shape(x: Array, source: str) -> tuple[int, ...]:
    """Compute the shape of sums over bands of rows, of BAND floats at most if possible."""
    b, rows, columns, channels = _convert_shape(x.shape, source, "plain")
    bands = 1
    while rows % (2 * bands) == 0 and rows // bands * columns * channels > BAND:
        bands *= 2
    return b * bands, 2, channels


def _call(symbol: str, shape: tuple[int, ...], *arrays: Array, **attributes: int | str) -> Array:
    numbers = {
        name: np.int64(LAYOUTS.index(value) if isinstance(value, str) else value)
        for name, value in attributes.items()
    }
    call = jax.ffi.ffi_call(
        NAMES[symbol], jax.ShapeDtypeStruct(shape, jnp.float32), vmap_method="sequential"
    )
    return call(*arrays, **numbers)


def is_available() -> bool:
    """Return whether JAX is on a CPU and there is a compiled form of the kernels.

    The first call of a process finds it in the cache, or compiles it.
    """
    if get_form() != "compiled":
        return False
    with _once:
        return jax.default_backend() == "cpu" and _load()


@functools.cache
def _load() -> bool:
    try:
        compiler = shlex.split(os.environ.get("CXX", "")) or ["c++"]
        if not shutil.which(compiler[0]):
            return False
        library = _load_library(compiler)
        for symbol, name in NAMES.items():
            jax.ffi.register_ffi_target(
                name, jax.ffi.pycapsule(getattr(library, symbol)), platform="cpu"
            )
    except (subprocess.SubprocessError, OSError, ValueError, RuntimeError) as error:
        output = (getattr(error, "stderr", None) or b"").decode(errors="replace").splitlines()
        reason = next((line for line in output if "error" in line), get_first_line(error))
        warnings.warn(
            f"training takes its slower form (CXX=none: without this note): {reason}",
            Note,
            stacklevel=2,
        )
        return False
    return True


def _load_library(compiler: list[str]) -> ctypes.CDLL:
    """Load the kernels from the cache folder, or compile them into it if they are not intact there.

    They are for this source, compiler, processor, user and JAX.
    """
    path = cache_folder().absolute() / f"compiled-{_compute_key(compiler)}.so"
    with contextlib.suppress(OSError):  # there is no such file
        if _is_intact(path):
            return ctypes.CDLL(str(path))
    _compile(compiler, path)
    return ctypes.CDLL(str(path))


def _compute_key(compiler: list[str]) -> str:
    # these macros identify compiler and processor
    macros = _run([*compiler, "-march=native", "-dM", "-E", "-x", "c++", os.devnull])
    user = str(getattr(os, "getuid", str)())
    settings = "\n".join([*compiler, *FLAGS, jaxlib.__version__, user]).encode()
    source = b"".join(path.read_bytes() for path in SOURCES)
    return hashlib.sha256(source + settings + macros).hexdigest()[:16]


def _compile(compiler: list[str], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{uuid.uuid4().hex}.so")
    try:
        sources = [str(source) for source in SOURCES if source.suffix == ".cc"]
        _run([*compiler, *FLAGS, f"-I{jax.ffi.include_dir()}", *sources, "-o", str(part)])
        with part.open("ab") as file:
            file.write(hashlib.sha256(part.read_bytes()).digest())
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _is_intact(path: Path) -> bool:
    """Return whether a library ends with the SHA-256 of its content, which loaders do not read.

    A damaged library would compute something else.
    """
    data = path.read_bytes()
    return hashlib.sha256(data[:-32]).digest() == data[-32:]


def _run(command: list[str]) -> bytes:
    return subprocess.run(command, check=True, capture_output=True, timeout=SECONDS).stdout
