"""The head on the pose code: what it answers, and that it stays able to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.model import pose_head

SHAPE = (4, 4, 16)


def codes(key, count=64):
    """As a ReLU leaves them: never negative."""
    return jnp.maximum(jax.random.normal(key, (count, *SHAPE)), 0)


@pytest.mark.parametrize("jit", [True, False])
def test_answers_are_five_of_each_code_on_its_own(jit):
    params, z_p = pose_head.init(SHAPE, 5, jax.random.key(0)), codes(jax.random.key(1))
    predict = jax.jit(pose_head.predict) if jit else pose_head.predict
    found = predict(params, z_p)
    assert found.shape == (64, 5) and found.dtype == jnp.float32 and 0 < found.min() < found.max() < 1
    np.testing.assert_allclose(predict(params, z_p[:3]), found[:3], rtol=1e-5)
    assert predict(params, z_p.astype(jnp.bfloat16)).dtype == jnp.float32


def test_what_lowers_all_units_at_once_lowers_none():
    """A step that the optimiser takes in every unit alike would, far enough, leave all of them at zero, where nothing is learnt."""
    params, z_p = pose_head.init(SHAPE, 5, jax.random.key(0)), codes(jax.random.key(1))
    first = params["Dense_0"]
    lowered = params | {"Dense_0": {"kernel": first["kernel"] - 0.1, "bias": first["bias"] - 0.1}}
    np.testing.assert_allclose(pose_head.predict(lowered, z_p), pose_head.predict(params, z_p), atol=2e-3)
    slope = jax.grad(lambda params: pose_head.predict(params, z_p).sum())(lowered)["Dense_1"]["kernel"]
    assert (jnp.abs(slope).max(1) > 0).all()
