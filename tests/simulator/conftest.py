"""A half-space, condensed once: the body for which closed forms exist."""

import pytest

from verification.half_space import HalfSpace
from verification.half_space import make_half_space as made
from verification.verify import INCOMPRESSIBLE


@pytest.fixture(scope="session")
def half_space() -> HalfSpace:
    return made(INCOMPRESSIBLE)
