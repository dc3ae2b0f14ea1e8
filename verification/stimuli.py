"""Stimuli of narrow, extreme and senseless shapes, by name."""

import jax.numpy as jnp
import numpy as np

from jaxunshear.simulator.shapes import make_disk, make_stroke
from jaxunshear.simulator.stimuli import Stimulus

_ARM = np.array([[(3 + a) * np.cos(a), (3 + a) * np.sin(a)] for a in np.linspace(0, 4 * np.pi, 81)])
SHAPES = {
    shape.name: shape
    for shape in (
        Stimulus("2-mm spiral arm", make_stroke(_ARM, 1.0), (3 + 2 * np.pi + 1.0, 0.0, 0.0), 17.0),
        Stimulus("smaller than a pin", make_disk(0.3), (0.0, 0.0, 0.0), 0.3),
        Stimulus("a point", make_disk(0.0), (0.0, 0.0, 0.0), 0.0),
        Stimulus(
            "a hair",
            make_stroke(np.array([[-40.0, 0.0], [40.0, 0.0]]), 0.0),
            (0.0, 0.0, 90.0),
            40.0,
        ),
        Stimulus("empty", lambda p: jnp.full(p.shape[:-1], 1e3, p.dtype), (0.0, 0.0, 0.0), 0.0),
        Stimulus(
            "everywhere", lambda p: jnp.full(p.shape[:-1], -1e3, p.dtype), (0.0, 0.0, 0.0), 1e3
        ),
        Stimulus("NaN", lambda p: p[..., 0] * jnp.nan, (0.0, 0.0, 0.0), 1.0),
        Stimulus(
            "infinite", lambda p: jnp.full(p.shape[:-1], jnp.inf, p.dtype), (0.0, 0.0, 0.0), 1.0
        ),
        Stimulus("NaN target", make_disk(50.0), (np.nan, 0.0, 0.0), 50.0),
    )
}
