"""Choose the layers of networks: plain ones of `layers.py`, or those of `fast/`.

Plain layers are written as a reader of the paper expects them; a CPU, and a GPU, computes the fast
ones in less time. Parameters are the same, values and gradients equal to rounding.

JAXUNSHEAR_KERNELS=plain or fast chooses for a process and for those that it starts; auto, the
default, takes fast layers on CPUs and GPUs, where both have been timed.
"""

import contextlib
import contextvars
from collections.abc import Iterator
from typing import TypeVar

import jax

from jaxunshear.environment import AUTO, FAST, PLAIN, read_kernels_choice
from jaxunshear.models.fast import compiled_kernels

T = TypeVar("T")
_chosen: contextvars.ContextVar[str | None] = contextvars.ContextVar("kernels", default=None)


def choose_layers() -> str:
    """Choose PLAIN or FAST. Raises UserError for another value of the variable."""
    choice = _chosen.get() or read_kernels_choice()
    if choice != AUTO:
        return choice
    return FAST if jax.default_backend() in ("cpu", "gpu") else PLAIN


@contextlib.contextmanager
def use_layers(choice: str) -> Iterator[None]:
    """Use PLAIN or FAST layers in what is traced within this context."""
    token = _chosen.set(choice)
    try:
        yield
    finally:
        _chosen.reset(token)


def describe_layers() -> str:
    """Describe the layers for results, and whether kernels are compiled for this processor."""
    choice = choose_layers()
    if choice == FAST and compiled_kernels.is_available():
        return f"{FAST}, compiled"
    return choice


def pick_layer(plain: T, fast: T) -> T:
    """Return the layer to build a network of."""
    return fast if choose_layers() == FAST else plain
