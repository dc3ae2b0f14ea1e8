"""Drawn outlines are stimuli like those with a name; what is no outline is refused in a line."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.apps.explore.outline import make_drawn_stimulus, trace_outlines
from jaxunshear.config.stimuli import MAX_CORNERS
from jaxunshear.errors import UserError
from jaxunshear.simulator.stimuli import STIMULI, compute_signed_distance

ANGLE = np.linspace(0, 2 * np.pi, 200, endpoint=False)
RING = 12 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], -1)


def test_a_drawn_circle_is_a_disk():
    stimulus = make_drawn_stimulus(RING[::-1])
    xy = jnp.array([[0.0, 0.0], [11.0, 0.0], [0.0, 15.0]])
    found = jax.jit(partial(compute_signed_distance, stimulus))(xy)
    np.testing.assert_allclose(found, [-12, -1, 3], atol=0.2)
    assert stimulus.extent_mm == pytest.approx(12, abs=0.2)


def test_outlines_run_along_the_edge():
    (curve,) = trace_outlines(make_drawn_stimulus(RING), 32.0)
    np.testing.assert_allclose(np.linalg.norm(curve, axis=-1), 12, atol=0.2)
    (half,) = trace_outlines(STIMULI["edge"], 32.0)  # closed beyond the border
    assert half[:, 0].min() < -31.5 and half[:, 0].max() == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((0, 2)), "a point or a line"),
        (np.array([[0.0, 0.0], [1.0, 1.0]]), "a point or a line"),
        (RING / 12, "encloses less"),
        (np.array([[0.0, 0.0], [10.0, 10.0], [10.0, 0.0], [-3.0, 20.0]]), "crosses itself"),
        (np.array([[0.0, 0.0], [np.nan, 1.0], [3.0, 0.0]]), "must be finite"),
        (np.repeat(RING, 3, 0) * (1 + 0.2 * (np.arange(600) % 2))[:, None], "corners"),
    ],
)
def test_what_is_no_outline_is_refused(points, reason):
    with pytest.raises(UserError, match=reason):
        make_drawn_stimulus(points)
    assert MAX_CORNERS < 600
