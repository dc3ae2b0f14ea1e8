"""Error against run time of the simulator: a row for every level, batch, number of steps, tolerance, precision, mesh and solver.

    rows = bench_sim(level="auto", batch=64)

Errors are of all pins of 63 scenes of the paper's distribution, against `reference`. Times are wall clock of `simulate`, warm
but with every system set up anew; `ratio` is to a 2048 x 2048 float32 matrix product timed in between.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from benchmarks.other_solvers import OTHER_SOLVERS
from benchmarks.reference_pins import solve_reference_pins
from jaxunshear.config.reach import RING_MM, compute_ring_spacing, set_ring_spacing
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import Json
from jaxunshear.progress import Progress
from jaxunshear.simulator import simulate as simulator
from jaxunshear.simulator import systems
from jaxunshear.simulator.contact_results import Contacts
from jaxunshear.simulator.level import LEVELS, Level, without_omissions
from jaxunshear.simulator.scene import Scenes
from verification.clock import make_matrix_product, time_call, time_repeats
from verification.paper import KINDS, NAMES, sample_paper_scenes
from verification.pin_distance import compute_pin_error

OWN_SOLVER = "admm"
WRONG_PX = 1.0  # rms: a solver that ends further off than this has failed
FINEST_MM = 0.7


@dataclass(frozen=True)
class Effort:
    """What is measured: how many scenes for errors (each shape in turn) and for times, repeats and their budget, which scenes they are,
    and against what."""

    compared: int = 63
    timed: int = 256
    slow_timed: int = 63  # timed, of rows that take a second a state
    repeats: int = 5
    budget_s: float = 15.0
    scenes: Callable[[str, int], Scenes] = sample_paper_scenes  # by kind and number
    truth: Level = LEVELS["reference"]


@dataclass(frozen=True)
class Setting:
    """One row to measure; `scenes` timed, None for the usual number."""

    name: str
    level: str
    level_settings: Level
    batch: int = 64
    solver: str = OWN_SOLVER
    mesh_mm: float | None = None  # None: the sensor's own
    kinds: tuple[str, ...] = KINDS
    scenes: int | None = None
    against: str = "reference"


def list_main_settings(effort: Effort, batches: Sequence[int] = (64, 1, 16)) -> Iterator[Setting]:
    """Level by level and batch by batch: what `--level` and `--batch` choose from."""
    for batch in batches:
        for name in ("auto", "fast"):
            yield Setting(
                f"{name}, batch {batch}",
                name,
                LEVELS[name],
                batch,
                scenes=effort.slow_timed if batch == 1 else None,
            )
    for batch in batches:
        full = {
            "unabridged": without_omissions(LEVELS["auto"]),
            "default": LEVELS["default"],
            "reference": LEVELS["reference"],
        }
        for name, how in full.items():
            label = "auto, nothing left out" if name == "unabridged" else name
            few = max(effort.slow_timed // (9 if batch < 64 else 1), 1)
            yield Setting(f"{label}, batch {batch}", name, how, batch, scenes=few)


def list_variations(effort: Effort) -> Iterator[Setting]:
    """`auto` at batch 64 with one thing changed."""
    auto = LEVELS["auto"]
    for tolerance in (1.0, 0.5, 0.1, 0.05, 0.02):
        how = replace(auto, tolerance=tolerance, limit=5000)
        yield Setting(f"auto, tolerance {tolerance:g}", "auto", how)
    for factor in (4, 2, 0.5, 0.25):
        how = replace(auto, press_mm=factor * auto.press_mm, slide_mm=factor * auto.slide_mm)
        yield Setting(f"auto, steps times {1 / factor:g}", "auto", how)
    yield Setting("auto, float64", "auto", replace(auto, precision="float64"))
    for solver in OTHER_SOLVERS:
        if solver == OWN_SOLVER:
            continue
        for tolerance in (0.5, 0.2, 0.05) if solver != "newton, cold" else (0.2,):
            how = replace(auto, tolerance=tolerance, limit=2000)
            batch, scenes = (
                (1, min(7, effort.slow_timed))
                if solver == "newton, cold"
                else (64, effort.slow_timed)
            )
            yield Setting(
                f"{solver}, tolerance {tolerance:g}",
                "auto",
                how,
                batch,
                solver,
                None,
                ("slide",),
                scenes,
            )
    for mesh in (2.0, 1.5, 1.0, FINEST_MM):
        against = f"tight auto at {FINEST_MM:g} mm"
        yield Setting(
            f"auto, mesh {mesh:g} mm",
            "auto",
            auto,
            mesh_mm=mesh,
            scenes=effort.slow_timed,
            against=against,
        )


def select_settings(effort: Effort, level: str | None, batch: int | None) -> list[Setting]:
    """All settings, or the plain ones of a level, of a batch, or of both."""
    if batch is not None and batch < 1:
        raise UserError(f"--batch {batch}: use at least 1")
    names = {setting.level for setting in list_main_settings(effort)}
    if level is not None and level not in names:
        raise UserError(f"--level '{level}' is unknown: use one of {', '.join(sorted(names))}")
    if level is None and batch is None:
        return [*list_main_settings(effort), *list_variations(effort)]
    plain = list_main_settings(effort) if batch is None else list_main_settings(effort, (batch,))
    return [setting for setting in plain if level is None or setting.level == level]


def bench_sim(
    level: str | None = None,
    batch: int | None = None,
    sensor: Sensor = TACTIP_331,
    effort: Effort | None = None,
    settings: Sequence[Setting] | None = None,
    keep: Callable[[list[Json]], None] = lambda rows: None,
) -> list[Json]:
    """Rows, slides and taps apart; `keep` gets those so far after each. Raises `UserError` for an unknown level."""
    effort = effort or Effort()
    settings = select_settings(effort, level, batch) if settings is None else settings
    work = [(setting, kind) for setting in settings for kind in setting.kinds]
    rows: list[Json] = []
    with Progress("bench sim", len(work), unit="rows") as progress:
        for setting, kind in work:
            rows.append(measure(sensor, setting, kind, effort))
            keep(rows)
            progress.advance(1)
    return rows


def measure(sensor: Sensor, setting: Setting, kind: str, effort: Effort) -> Json:
    """One row. A solver that crashes is a row too."""
    scenes = effort.scenes(kind, setting.scenes or effort.timed)
    compared = scenes.take(np.arange(min(effort.compared, len(scenes))))
    row: Json = {
        "name": setting.name,
        "level": setting.level,
        "kind": kind,
        "batch": setting.batch,
        "precision": setting.level_settings.precision,
        "tolerance": setting.level_settings.tolerance,
        "press_mm": setting.level_settings.press_mm,
        "slide_mm": setting.level_settings.slide_mm,
        "solver": setting.solver,
        "mesh_mm": setting.mesh_mm or compute_ring_spacing(sensor),
        "against": setting.against,
        "scenes": len(compared),
        "timed_scenes": len(scenes),
    }
    pins = _truth(sensor, setting, kind, effort)[: len(compared)]
    contacts: list[Contacts] = []
    here = sensor if setting.mesh_mm is None else set_ring_spacing(sensor, setting.mesh_mm)
    how = replace(setting.level_settings, solver=OTHER_SOLVERS[setting.solver])

    def work() -> None:
        systems.build_system.cache_clear()
        contacts[:] = [simulator.simulate(here, NAMES, scenes, how, setting.batch, retry=False)]

    systems.load_shared_dome(here)
    jax.clear_caches()
    product = make_matrix_product()
    try:
        first = time_call(work)
        spent = time_repeats(work, product, effort.repeats, effort.budget_s)
    except Exception as crash:
        return {**row, "failed": f"crashed: {type(crash).__name__}: {get_first_line(crash)}"}
    planned = min(
        time_call(lambda: simulator.plan(here, NAMES, scenes, how, setting.batch)) for _ in range(2)
    )
    each = 1e3 * spent.work / len(scenes)
    part = contacts[0]
    error = compute_pin_error(sensor, part.pins[: len(compared)], pins)
    found = {
        "ms_per_state": float(np.median(each)),
        "ms_p95": float(np.percentile(each, 95)),
        "ratio": spent.ratio / len(scenes),
        "product_ms": float(1e3 * np.median(spent.product)),
        "repeats": len(each),
        "compile_s": max(float(first - spent.work[0]), 0.0),
        "plan_ms": 1e3 * planned / len(scenes),
        **error._asdict(),
        "iterations": float(part.iterations.mean()),
        "converged": float(part.converged.mean()),
        "nodes": float(part.nodes.mean()),
    }
    return {**row, **found, "failed": _failure(part, error.rms_px, setting)}


def _truth(sensor: Sensor, setting: Setting, kind: str, effort: Effort) -> np.ndarray:
    """(effort.compared, P, 3) mm: always of all scenes that errors are measured on, so that one answer serves every row."""
    scenes = effort.scenes(kind, effort.compared)
    if setting.against == "reference":
        return solve_reference_pins(sensor, NAMES, scenes, effort.truth)
    finest = set_ring_spacing(sensor, FINEST_MM)
    return solve_reference_pins(
        finest, NAMES, scenes, replace(LEVELS["auto"], tolerance=0.02, limit=5000)
    )


def _failure(contacts: Contacts, rms_px: float, setting: Setting) -> str:
    """Why the row counts as a failure, or nothing."""
    if not np.isfinite(contacts.pins).all():
        lost = int(np.sum(~np.isfinite(contacts.pins).all(axis=(1, 2))))
        return f"{lost} of {len(contacts.pins)} states are not finite"
    if not contacts.converged.all():
        lost = int(np.sum(~contacts.converged))
        return f"{lost} of {len(contacts.pins)} states do not converge, rms error {rms_px:.2g} px"
    if rms_px > WRONG_PX and setting.solver != OWN_SOLVER:
        return f"converges to something else: rms error {rms_px:.2g} px"
    return ""


def table(rows: Sequence[Json]) -> str:
    """For people, slides and taps apart."""
    lines = []
    for kind in KINDS:
        shown = [row for row in rows if row["kind"] == kind]
        if not shown:
            continue
        width = max(len(row["name"]) for row in shown)
        lines.append(
            f"\n{kind}s\n{'':{width}}  ms/state    p95   ratio  compile s  plan ms   rms px  p95 px   rms mm  p95 mm  iter.  conv."
        )
        lines += [_line(row, width) for row in shown]
    return "\n".join([*lines, "", *_verdicts(rows)])


def _line(row: Json, width: int) -> str:
    if "ratio" not in row:
        return f"{row['name']:{width}}  FAILED: {row['failed']}"
    note = f"  FAILED: {row['failed']}" if row["failed"] else ""
    if row["against"] != "reference":
        note = f"  (against {row['against']}){note}"
    return (
        f"{row['name']:{width}}  {row['ms_per_state']:8.3g} {row['ms_p95']:6.3g} {row['ratio']:7.3f} {row['compile_s']:10.1f} "
        f"{row['plan_ms']:8.2f} {row['rms_px']:8.3f} {row['p95_px']:7.3f} {row['rms_mm']:8.4f} {row['p95_mm']:7.4f} "
        f"{row['iterations']:6.0f} {row['converged']:6.2f}{note}"
    )


def _verdicts(rows: Sequence[Json]) -> Iterator[str]:
    """What `auto` at batch 64 gains over the same level with nothing left out, both timed with the same scenes: as is its row among
    the meshes, but for small efforts not that of the batches."""
    for kind in KINDS:
        pair = [
            next(
                (
                    row
                    for row in rows
                    if (row["kind"], row["name"]) == (kind, name) and "ratio" in row
                ),
                None,
            )
            for name in (f"auto, mesh {RING_MM:g} mm", "auto, nothing left out, batch 64")
        ]
        if pair[0] and pair[1] and pair[0]["timed_scenes"] == pair[1]["timed_scenes"]:
            share = pair[0]["ratio"] / pair[1]["ratio"]
            yield f"{kind}s: what auto leaves out brings it to {share:.3f} of the time"
