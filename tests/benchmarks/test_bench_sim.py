"""Error against run time: rows, what counts as a failure, and scenes that never change."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import bench_figure, bench_sim, other_solvers
from benchmarks.bench_sim import Effort, Setting, set_ring_spacing
from benchmarks.bench_sim import bench_sim as bench
from jaxunshear.config.contact_rings import compute_ring_spacing
from jaxunshear.errors import UserError
from jaxunshear.simulator.level import LEVELS
from jaxunshear.simulator.scene import Scenes
from verification.clock import time_repeats
from verification.contact_case import HALF_SIZE
from verification.paper import NAMES, sample_paper_scenes

LOOSE = replace(LEVELS["auto"], tolerance=0.3)


def shallow(kind: str, count: int) -> Scenes:
    found = sample_paper_scenes(kind, count)
    found.pose[:, 3] = 1.0
    return found


# contacts and a truth that cost little: 1 mm deep on the small dome, against float64
EXACT = replace(LEVELS["auto"], tolerance=0.01, precision="float64")
SMALL = Effort(compared=2, timed=2, slow_timed=1, repeats=1, scenes=shallow, truth=EXACT)


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """Nothing that an earlier run left behind, but domes once."""
    folder = tmp_path_factory.getbasetemp() / "cache"
    monkeypatch.setenv("JAXUNSHEAR_CACHE", str(folder))


def run(*settings: Setting, **more) -> list[dict]:
    return bench(sensor=HALF_SIZE, effort=SMALL, settings=settings, **more)


@pytest.mark.long
def test_a_row_says_all_there_is_to_say():
    kept = []
    setting = Setting("auto, batch 2", "auto", LEVELS["auto"], 2)
    rows = run(setting, keep=lambda rows: kept.append(len(rows)))
    assert [row["kind"] for row in rows] == ["slide", "tap"] and kept == [1, 2]
    named = {"level", "batch", "solver", "mesh_mm", "against", "precision", *bench_sim.COLUMNS}
    for row in rows:
        assert set(row) >= named
        assert row["converged"] == 1 and not row["failed"] and row["nodes"] > 0
        assert 0 < row["rms_px"] <= row["p95_px"] * 3 and row["rms_px"] < 0.5
        assert row["ms_per_state"] > 0 and row["ratio"] > 0
    assert "auto, batch 2" in bench_sim.format_table(rows)
    assert bench_figure.plot_work_precision(rows)[:4] == b"\x89PNG"


@pytest.mark.long
def test_a_solver_that_does_not_converge_fails_and_is_shown():
    level = replace(LEVELS["auto"], limit=5, tolerance=1e-3)
    (row,) = run(Setting("slow", "auto", level, 2, "projected gradient", kinds=("slide",)))
    assert row["converged"] < 1 and "do not converge" in row["failed"]
    assert "do not converge" in bench_sim.format_table([row])


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ZeroDivisionError("by nothing"), "by nothing"),
        pytest.param(MemoryError(), "MemoryError", marks=pytest.mark.long),
    ],
)
def test_a_solver_that_crashes_is_a_row(monkeypatch, error, said):
    def crash(*_):
        raise error

    monkeypatch.setitem(other_solvers.OTHER_SOLVERS, "broken", crash)
    none = np.zeros((2, HALF_SIZE.pins, 3))  # no error is measured
    monkeypatch.setattr(bench_sim, "solve_reference_pins", lambda *_: none)
    (row,) = run(Setting("broken", "auto", LOOSE, 2, "broken", kinds=("slide",)))
    assert "crashed" in row["failed"] and said in row["failed"]
    assert "crashed" in bench_sim.format_table([row]) and bench_figure.plot_work_precision([row])


ACCURATE = replace(LEVELS["auto"], tolerance=0.02, limit=2000)
SHORT = replace(LEVELS["auto"], tolerance=0.01, press_mm=0.25)
LONG = pytest.mark.long


@pytest.mark.parametrize(
    ("solver", "level", "kind"),
    [
        ("admm with anderson", ACCURATE, "slide"),
        pytest.param("accelerated projected gradient", ACCURATE, "slide", marks=LONG),
        # one press of a millimetre: near enough to zero force, where Newton is right
        pytest.param("newton, cold", SHORT, "tap", marks=LONG),
    ],
)
def test_rivals_find_the_same_contact(solver, level, kind):
    (row,) = run(Setting("rival", "auto", level, 2, solver, kinds=(kind,)))
    assert row["converged"] == 1 and row["rms_px"] < 0.1 and not row["failed"]


def test_what_is_chosen():
    def select(level, batch):
        return bench_sim.select_settings(Effort(), level, batch)

    assert [(s.level, s.batch, s.solver) for s in select("auto", 64)] == [("auto", 64, "admm")]
    assert {s.batch for s in select(None, 16)} == {16}
    everything = select(None, None)
    assert {"fast", "auto", "default", "reference", "unabridged"} <= {s.level for s in everything}
    assert {s.solver for s in everything} == set(other_solvers.OTHER_SOLVERS)
    assert len({s.name for s in everything}) == len(everything)
    for wrong, said in ((("best", None), "--level 'best'"), ((None, 0), "--batch 0")):
        with pytest.raises(UserError, match=said):
            select(*wrong)


def test_scenes_are_the_same_again_and_few_are_the_first_of_many():
    few, many = sample_paper_scenes("slide", 9), sample_paper_scenes("slide", 14)
    assert np.array_equal(few.pose, many.pose[:9]) and np.array_equal(few.move, many.move[:9])
    assert set(many.stimulus) == set(range(len(NAMES)))
    taps = sample_paper_scenes("tap", 9)
    assert np.array_equal(taps.pose, few.pose) and not taps.move.any() and few.move.any()
    assert not np.array_equal(sample_paper_scenes("slide", 9, seed=1).pose, few.pose)
    assert few.pose[:, 3].min() >= 1 and few.pose[:, 3].max() <= 6


def test_another_spacing_is_another_sensor():
    coarse = set_ring_spacing(HALF_SIZE, 1.5)
    assert coarse.name != HALF_SIZE.name
    most = 10 * np.pi / 3 / 8  # not beyond 8 rings
    assert compute_ring_spacing(coarse) == pytest.approx(most)
    assert compute_ring_spacing(set_ring_spacing(HALF_SIZE, 0.8)) == 0.8
    assert set_ring_spacing(HALF_SIZE, 1.0) is HALF_SIZE
    assert compute_ring_spacing(HALF_SIZE) == 1.0


def test_laps_stop_when_the_budget_is_spent():
    calls = []
    spent = time_repeats(lambda: calls.append(0), lambda: None, repeats=4)
    assert len(calls) == len(spent.work) == len(spent.product) == 4
    spent = time_repeats(lambda: calls.append(0), lambda: None, repeats=4, budget_s=0.0)
    assert len(spent.work) == 1
