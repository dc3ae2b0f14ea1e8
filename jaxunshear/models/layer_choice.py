"""Which layers networks are built of: those of `layers.py`, as a reader of the paper expects them, or those of `fast/`, which a CPU
computes faster, and a GPU, too. Parameters are the same, values and gradients equal to rounding.

JAXUNSHEAR_KERNELS=plain or fast chooses for a process and for those that it starts; auto, the default, takes fast ones on CPUs and GPUs,
where both have been timed.
"""

import contextlib
import contextvars
from collections.abc import Iterator
from typing import TypeVar

import jax

from jaxunshear.environment import AUTO, FAST, PLAIN, read_kernels_choice
from jaxunshear.models.fast import compiled_kernels

T = TypeVar("T")
_asked: contextvars.ContextVar[str | None] = contextvars.ContextVar("kernels", default=None)


def choose_layers() -> str:
    """PLAIN or FAST. Raises UserError for another value of the variable."""
    way = _asked.get() or read_kernels_choice()
    if way != AUTO:
        return way
    return FAST if jax.default_backend() in ("cpu", "gpu") else PLAIN


@contextlib.contextmanager
def use_layers(way: str) -> Iterator[None]:
    """What is traced herein is of these layers."""
    token = _asked.set(way)
    try:
        yield
    finally:
        _asked.reset(token)


def describe_layers() -> str:
    """For results: which layers, and whether those of a training were compiled for this processor."""
    return (
        f"{FAST}, compiled"
        if choose_layers() == FAST
        and compiled_kernels.get_form() == "compiled"
        and compiled_kernels.is_available()
        else choose_layers()
    )


def pick_layer(plain: T, fast: T) -> T:
    """The one to build a network of."""
    return fast if choose_layers() == FAST else plain
