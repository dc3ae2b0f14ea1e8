"""Shapes in signatures hold wherever a test calls: silent broadcasting is refused."""

import importlib
import pkgutil
from inspect import isfunction

import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from jaxtyping import Float, TypeCheckError, jaxtyped

from jaxunshear.models import distances
from jaxunshear.perception.lattice import make_lattice
from tests import shapes

IMAGES = jnp.zeros((2, 8, 8, 1))


def test_ranks_letters_and_kinds_are_checked():
    assert distances.compute_supervised_loss(IMAGES, np.asarray(IMAGES)).shape == (2,)
    for wrong in (IMAGES[..., 0], IMAGES[:1], IMAGES[:, :1], IMAGES.astype(int)):
        with pytest.raises(TypeCheckError, match="parameter 'target'"):
            distances.compute_supervised_loss(IMAGES, wrong)


def test_arrays_of_numpy_are_checked_too():
    place = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    assert make_lattice(place).rest.shape == (25, 2)
    with pytest.raises(TypeCheckError, match="parameter 'rest'"):
        make_lattice(np.zeros((25, 3)))


def test_answers_are_checked_and_other_types_are_not():
    @jaxtyped(typechecker=shapes.checked)
    def mean(values: Float[Array, "B K"], axis: int) -> Float[Array, "B"]:
        return values.mean(axis)

    assert mean(jnp.ones((2, 3)), np.int64(1)).shape == (2,)
    with pytest.raises(TypeCheckError, match="return value"):
        mean(jnp.ones((2, 3)), 0)


@pytest.mark.parametrize("name", shapes.MODULES)
def test_every_step_that_is_named_is_checked(name):
    top = importlib.import_module(name)
    files = [
        top.__name__,
        *(
            file.name
            for file in pkgutil.iter_modules(getattr(top, "__path__", ()), f"{top.__name__}.")
        ),
    ]
    functions = [
        f for file in files for f in vars(importlib.import_module(file)).values() if isfunction(f)
    ]
    mine = [f for f in functions if f.__module__ in files and "jaxtyping" in str(f.__annotations__)]
    assert mine and all(hasattr(f, "__wrapped__") for f in mine)
