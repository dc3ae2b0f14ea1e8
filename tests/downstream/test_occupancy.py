"""Evidence of lying over an object: learnt from a made-up skin whose cells grow most at an edge, as real ones do."""

import numpy as np
import pytest

from jaxunshear.downstream.occupancy import CERTAIN, evidence, learn
from jaxunshear.downstream.reconstruct import skin_places
from jaxunshear.image.lattice import make_lattice
from jaxunshear.settings.sensor import TACTIP_331

PLACE = skin_places(TACTIP_331)
LATTICE = make_lattice(6 * PLACE)


def taps(count, seed):
    """Growths (N, P) and distances (N, P) mm of straight edges at random; 0.12 far inside, 0.17 at the edge, 0.12 at 1.5 mm outside."""
    rng = np.random.default_rng(seed)
    angle, offset = rng.uniform(0, 2 * np.pi, count), rng.uniform(-4, 4, count)
    distance = np.cos(angle)[:, None] * PLACE[:, 0] + np.sin(angle)[:, None] * PLACE[:, 1] - offset[:, None]
    growth = np.where(distance < 0, 0.12 + 0.05 * np.exp(distance), 0.17 * np.exp(-((distance / 2.5) ** 2)))
    return growth + rng.normal(0, 0.004, growth.shape), distance


@pytest.fixture(scope="module")
def occupancy():
    growth, distance = taps(80, 0)
    growth[3] = np.nan  # an image whose pins were not identified
    return learn(LATTICE, PLACE, growth, distance)


def test_both_sides_of_new_edges_are_reported_apart(occupancy):
    growth, distance = taps(40, 1)
    said, apart = evidence(occupancy, growth), distance[:, occupancy.near]
    clear = np.abs(apart) > 1
    assert np.mean((said > 0)[clear] == (apart < 0)[clear]) > 0.97
    by_growth_alone = (growth[:, occupancy.near] > 0.12)[clear] == (apart < 0)[clear]
    assert np.mean(by_growth_alone) < 0.9


def test_evidence_changes_sign_at_the_edge(occupancy):
    growth, distance = taps(200, 2)
    said, apart = evidence(occupancy, growth), distance[:, occupancy.near]
    assert abs(said[np.abs(apart) < 0.5].mean()) < 0.15
    assert said[(apart > -1.5) & (apart < -0.5)].mean() > 0.3 and said[(apart < 1.5) & (apart > 0.5)].mean() < -0.3


def test_bounded_and_unknown_stays_unknown(occupancy):
    growth, _ = taps(2, 3)
    growth[0] = np.nan
    growth[1] *= 1e6
    said = evidence(occupancy, growth)
    assert np.isnan(said[0]).all() and np.abs(said[1]).max() <= CERTAIN + abs(occupancy.level)
