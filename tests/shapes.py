"""What tests check of every call, by the signature: kinds and shapes of arrays, and that a letter stands for one number.

All other types are mypy's to check, and what a function refuses by an error of its own stays its own.
"""

from collections.abc import Callable
from typing import Any, get_args

from beartype import beartype
from jaxtyping import AbstractArray, install_import_hook

CHECKED = ("metrics", "scene", "contact", "model")
# without what follows pins: checks would take a third of its time
CHECKED += ("image.camera", "image.dots", "image.grey", "image.lattice", "image.png", "image.preprocess")
CHECKED += ("training.losses", "training.turning", "training.drawing")


def check_all() -> None:
    """Before any of them is imported. Processes that a test starts run without."""
    install_import_hook([f"jaxunshear.{name}" for name in CHECKED], f"{__name__}.checked")


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    hints = function.__annotations__.items()
    function.__annotations__ = {name: hint for name, hint in hints if _of_arrays(hint)}
    return beartype(function)


def _of_arrays(hint: Any) -> bool:
    return (isinstance(hint, type) and issubclass(hint, AbstractArray)) or any(map(_of_arrays, get_args(hint)))
