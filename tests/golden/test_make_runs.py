"""The comparison with golden results must notice what it is for."""

import json

import numpy as np
import pytest

from tests.golden import make_runs
from tests.golden.make_runs import differences, summarise

GOLDEN = {"loss": 0.25, "bits": "a1", "steps": 12, "pins": [1.0, -2.0]}


@pytest.mark.parametrize(
    ("change", "exact", "elsewhere"),
    [
        ({}, 0, 0),
        ({"loss": 0.25 + 1e-12, "bits": "b2"}, 2, 0),
        ({"loss": 0.2525}, 1, 1),
        ({"loss": float("nan")}, 1, 1),
        ({"steps": 13}, 1, 1),
        ({"pins": [1.0, 2.0]}, 1, 1),
        ({"pins": [1.0]}, 1, 1),
        ({"new": 1.0}, 1, 1),
    ],
)
def test_differences_of_golden_figures(change, exact, elsewhere):
    assert len(list(differences(GOLDEN, GOLDEN | change, 0.0))) == exact
    assert len(list(differences(GOLDEN, GOLDEN | change, 1e-3))) == elsewhere
    assert len(list(differences(GOLDEN | change, GOLDEN, 0.0))) == exact


def test_a_summary_knows_bits_but_no_order():
    some, other = np.float32([1, -2]), np.float32([[3]])
    assert summarise([some, other]) == summarise([other, some])
    found = summarise([some, other, np.float32([np.nextafter(np.float32(3), np.float32(4))])])
    assert found != summarise([some, other, np.float32([3])])


def test_every_section_is_held():
    golden = json.loads(make_runs.FILE.read_text())
    assert golden.keys() == {"machine", *make_runs.TOLERANCES}
    texts = [(make_runs.ROOT / name).read_text() for name in make_runs.TESTS]
    for section in make_runs.TOLERANCES:
        assert any(f'hold("{section}"' in text for text in texts)
