import json

import numpy as np
import pytest

from benchmarks import confidence
from benchmarks.confidence import Group, Observed, auc, calibrate, measure, recorded, wilson
from jaxunshear.image.understood import ALLOWED, Expected, Seen, verdict

EXPECTED = Expected(331, 0.04, 0.375, (0.5, 0.5), 0.98)


def _seen(rng, pins=331, spread=0.02, count=60):
    return [
        Seen(round(pins * np.exp(off)), 0.04 * np.exp(-off), 0.375 * np.exp(off), (0.5 + off / 4, 0.5), 0.96, False)
        for off in rng.normal(0, spread, count)
    ]


@pytest.fixture
def observed():
    rng = np.random.default_rng(0)
    nothing = [Seen(3, 0.0, 0.0, (0.0, 0.0), 0.0, False)] * 10
    return [Observed("a", EXPECTED, _seen(rng), {"fewer": _seen(rng, 127), "nothing": nothing})]


def test_weights_are_those_of_what_differs(observed):
    base, weights = calibrate(observed)
    assert base > 1 and set(weights) == set(ALLOWED)
    assert weights["pins"] > 0.1  # the strangers differ in their number alone
    assert max(weight for name, weight in weights.items() if name != "pins") < weights["pins"] / 2


def test_rows(observed):
    rows = {row["name"]: row for row in measure(observed)}
    assert rows["a"]["images"] == 60 and rows["a"]["refused"] == 0 and 0 < rows["a"]["high"] < 0.07
    assert rows["fewer"]["accepted"] == rows["nothing"]["accepted"] == 0
    assert rows["all strangers"]["images"] == 70 and rows["all strangers"]["auc"] == 1
    doubled = [observed[0]._replace(strange={"the same": observed[0].known})]
    rows = {row["name"]: row for row in measure(doubled)}
    assert rows["the same"]["auc"] == 0.5 and rows["the same"]["accepted"] == 1


@pytest.mark.long
def test_the_command_keeps_its_rows(benchmarks, monkeypatch, tmp_path):
    monkeypatch.setattr(confidence, "COUNT", 4)
    answer = benchmarks("strangers", "--seed", "3", "--json", tmp_path / "rows.json")
    assert answer.code == 0, answer.err
    rows = {row["name"]: row for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}
    assert rows["simulated, tactip331"]["images"] == rows["white noise"]["images"] / 2 == 4
    assert rows["all known"]["refused"] == 0 and rows["white noise"]["accepted"] == 0 and "white noise" in answer.out
    assert benchmarks("strangers", "--size", "128").code == 2


def test_auc():
    assert auc(np.array([0.9, 0.8]), np.array([0.1, 0.2, 0.3])) == 1
    assert auc(np.array([0.9, 0.2]), np.array([0.1, 0.5])) == 0.75
    assert auc(np.array([0.5]), np.array([0.5])) == 0.5


def test_wilson():
    low, high = wilson(2, 20)  # (0.0279, 0.3010): Newcombe 1998, the formula by hand
    assert low == pytest.approx(0.0279, abs=2e-4) and high == pytest.approx(0.3010, abs=2e-4)
    assert wilson(0, 10)[0] == 0 and wilson(10, 10)[1] == 1


def test_real_recordings(real_recordings):
    group = recorded(real_recordings / "surface_3d_sample", 12, 0)
    assert isinstance(group, Group) and group.images.shape == (12, 128, 128)
    assert verdict(group.images, group.expected).ok
