"""Checks kinds and shapes of arrays in every call, by the signature.

A letter of a shape stands for one number.

mypy checks all other types. What a function refuses by an error of its own is left to it.
"""

from collections.abc import Callable
from functools import partial
from inspect import isfunction
from types import UnionType
from typing import Any, Union, get_args, get_origin

import jaxtyping
import numpy as np
from beartype import beartype
from jax import Array
from jaxtyping import AbstractArray, install_import_hook, jaxtyped

CHECKED = ("metrics", "simulator", "models")
# without what follows pins: checks would take a third of its time
CHECKED += (
    "perception.drawing",
    "perception.grey",
    "perception.lattice",
    "perception.preprocess",
)
CHECKED += ("training.augmentation",)
MODULES = [f"jaxunshear.{name}" for name in CHECKED]
MODULES += ["verification.hyperelastic", "verification.large_strain"]


def check_all() -> None:
    """Before any of them is imported. Processes that a test starts run without."""
    install_import_hook(MODULES, f"{__name__}.checked")
    jaxtyping.jaxtyped = check_arrays  # which the hook writes above every function


def check_arrays(target: Any = None, **settings: Any) -> Any:
    """Check functions that have arrays, as jaxtyping does; leave others, whose calls it slows."""
    if target is None:
        return partial(check_arrays, **settings)
    if isfunction(target) and not any(map(_of_arrays, target.__annotations__.values())):
        return target
    return jaxtyped(target, **settings)


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    hints = function.__annotations__.items()
    function.__annotations__ = {name: _of_either(hint) for name, hint in hints if _of_arrays(hint)}
    return beartype(function)


def _of_arrays(hint: Any) -> bool:
    return _is_array(hint) or any(map(_of_arrays, get_args(hint)))


def _is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray)


def _of_either(hint: Any) -> Any:
    """Accept arrays of numpy for those of JAX, and numbers for those without axes, as JAX does."""
    if _is_array(hint):
        kinds = Array | np.ndarray if hint.array_type is Array else hint.array_type
        arrays = hint.dtype[kinds, hint.dim_str]
        return arrays if hint.dim_str else arrays | float | int
    if not _of_arrays(hint):
        return hint
    inside = tuple(map(_of_either, get_args(hint)))
    return Union[inside] if get_origin(hint) in (Union, UnionType) else get_origin(hint)[inside]  # noqa: UP007
