"""A half-space, condensed once: the body for which closed forms exist."""

import pytest

from jaxunshear.verification.half_space import HalfSpace
from jaxunshear.verification.half_space import half_space as made
from jaxunshear.verification.verify import INCOMPRESSIBLE


@pytest.fixture(scope="session")
def half_space() -> HalfSpace:
    return made(INCOMPRESSIBLE)
