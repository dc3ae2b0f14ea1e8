"""Measures error against run time of the simulator.

    rows = bench_sim(level="auto", batch=64)

There is a row for every level, batch, number of steps, tolerance, precision, mesh and solver.
Errors are of all pins of 63 scenes of the paper's distribution, against `reference`. Times are wall
clock of `simulate`, compiled but with every system set up anew; `ratio` is to a 2048 x 2048 float32
matrix product timed in between.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import jax
import numpy as np

from benchmarks.other_solvers import OTHER_SOLVERS
from benchmarks.reference_pins import solve_reference_pins
from jaxunshear.config.contact_rings import RING_MM, compute_ring_spacing
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import Json
from jaxunshear.progress import Progress
from jaxunshear.simulator import simulate as simulator
from jaxunshear.simulator import systems
from jaxunshear.simulator.contacts import Contacts
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.level import LEVELS, Level
from jaxunshear.simulator.scene import Scenes
from jaxunshear.text_table import format_text_table
from verification.clock import make_matrix_product, time_call, time_repeats
from verification.paper import KINDS, NAMES, sample_paper_scenes
from verification.pin_distance import compute_pin_error

OWN_SOLVER = "admm"
WRONG_PX = 1.0  # rms: a solver that ends further off than this has failed
FINEST_MM = 0.7
COLUMNS = (
    *("kind", "name", "ms_per_state", "ms_p95", "ratio", "compile_s", "plan_ms"),
    *("rms_px", "p95_px", "rms_mm", "p95_mm", "iterations", "converged", "failed"),
)


@dataclass(frozen=True)
class RingSpacedSensor(Sensor):
    """A sensor whose contact rings have a spacing that does not follow from its size."""

    ring_mm: float = RING_MM


def set_ring_spacing(sensor: Sensor, ring_mm: float) -> Sensor:
    """Return the sensor with rings of this spacing, which its name then says."""
    if ring_mm == compute_ring_spacing(sensor):
        return sensor
    fields = asdict(sensor) | {"name": f"{sensor.name}-{ring_mm:g}mm"}
    return RingSpacedSensor(**fields, ring_mm=ring_mm)


@dataclass(frozen=True)
class Effort:
    """How much is measured, on which scenes, and against which level."""

    compared: int = 63  # scenes for errors, each shape in turn
    timed: int = 256  # scenes for times
    slow_timed: int = 63  # scenes for times of rows that take a second per state
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
    """Yield the settings that `--level` and `--batch` choose from."""
    for batch in batches:
        few = effort.slow_timed if batch == 1 else None
        for name in ("auto", "fast"):
            yield Setting(f"{name}, batch {batch}", name, LEVELS[name], batch, scenes=few)
    unabridged = replace(LEVELS["auto"], omit=())
    for batch in batches:
        few = max(effort.slow_timed // (9 if batch < 64 else 1), 1)
        yield Setting(
            f"auto, nothing left out, batch {batch}", "unabridged", unabridged, batch, scenes=few
        )
        for name in ("default", "reference"):
            yield Setting(f"{name}, batch {batch}", name, LEVELS[name], batch, scenes=few)


def list_variations(effort: Effort) -> Iterator[Setting]:
    """Yield `auto` at batch 64 with one setting changed."""
    auto, slow = LEVELS["auto"], effort.slow_timed
    for tolerance in (1.0, 0.5, 0.1, 0.05, 0.02):
        changed = replace(auto, tolerance=tolerance, limit=5000)
        yield Setting(f"auto, tolerance {tolerance:g}", "auto", changed)
    for factor in (4, 2, 0.5, 0.25):
        changed = replace(auto, press_mm=factor * auto.press_mm, slide_mm=factor * auto.slide_mm)
        yield Setting(f"auto, steps times {1 / factor:g}", "auto", changed)
    yield Setting("auto, float64", "auto", replace(auto, precision="float64"))
    for solver in list(OTHER_SOLVERS)[1:]:  # the first is our own
        newton = solver == "newton, cold"
        batch, scenes = (1, min(7, slow)) if newton else (64, slow)
        for tolerance in (0.2,) if newton else (0.5, 0.2, 0.05):
            name = f"{solver}, tolerance {tolerance:g}"
            changed = replace(auto, tolerance=tolerance, limit=2000)
            yield Setting(name, "auto", changed, batch, solver, kinds=("slide",), scenes=scenes)
    against = f"tight auto at {FINEST_MM:g} mm"
    for mesh in (2.0, 1.5, 1.0, FINEST_MM):
        name = f"auto, mesh {mesh:g} mm"
        yield Setting(name, "auto", auto, mesh_mm=mesh, scenes=slow, against=against)


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
    """Return rows, slides and taps separately; `keep` gets the rows so far after each.

    Raises UserError for an unknown level.
    """
    effort = effort or Effort()
    settings = select_settings(effort, level, batch) if settings is None else settings
    work = [(setting, kind) for setting in settings for kind in setting.kinds]
    rows: list[Json] = []
    with Progress("bench sim", len(work), unit="rows") as progress:
        for setting, kind in work:
            rows.append(measure_setting(sensor, setting, kind, effort))
            keep(rows)
            progress.advance(1)
    return rows


def measure_setting(sensor: Sensor, setting: Setting, kind: str, effort: Effort) -> Json:
    """Measure one row. A solver that crashes is a row, too."""
    scenes = effort.scenes(kind, setting.scenes or effort.timed)
    compared = scenes.take(np.arange(min(effort.compared, len(scenes))))
    row = _describe_setting(sensor, setting, kind) | {
        "scenes": len(compared),
        "timed_scenes": len(scenes),
    }
    pins = _solve_truth(sensor, setting, kind, effort)[: len(compared)]
    contacts: list[Contacts] = []
    meshed = sensor if setting.mesh_mm is None else set_ring_spacing(sensor, setting.mesh_mm)
    level = replace(setting.level_settings, method=OTHER_SOLVERS[setting.solver])

    def work() -> None:
        systems.build_system.cache_clear()
        contacts[:] = [simulator.simulate(meshed, NAMES, scenes, level, setting.batch, retry=False)]

    load_shared_dome(meshed)
    jax.clear_caches()
    product = make_matrix_product()
    try:
        first = time_call(work)
        times = time_repeats(work, product, effort.repeats, effort.budget_s)
    except Exception as crash:
        return {**row, "failed": f"crashed: {type(crash).__name__}: {get_first_line(crash)}"}
    plan_s = min(
        time_call(lambda: simulator.plan(meshed, NAMES, scenes, level, setting.batch))
        for _ in range(2)
    )
    ms_per_state = 1e3 * times.work / len(scenes)
    result = contacts[0]
    error = compute_pin_error(sensor, result.pins[: len(compared)], pins)
    return row | {
        "ms_per_state": float(np.median(ms_per_state)),
        "ms_p95": float(np.percentile(ms_per_state, 95)),
        "ratio": times.ratio / len(scenes),
        "product_ms": float(1e3 * np.median(times.product)),
        "repeats": len(ms_per_state),
        "compile_s": max(float(first - times.work[0]), 0.0),
        "plan_ms": 1e3 * plan_s / len(scenes),
        **error._asdict(),
        "iterations": float(result.iterations.mean()),
        "converged": float(result.converged.mean()),
        "nodes": float(result.nodes.mean()),
        "failed": _describe_failure(result, error.rms_px, setting),
    }


def _describe_setting(sensor: Sensor, setting: Setting, kind: str) -> Json:
    return {
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
    }


def _solve_truth(sensor: Sensor, setting: Setting, kind: str, effort: Effort) -> np.ndarray:
    """Solve what a row is compared with: pins (effort.compared, P, 3) mm.

    It is always of all scenes for errors, so one answer serves every row.
    """
    scenes = effort.scenes(kind, effort.compared)
    if setting.against == "reference":
        return solve_reference_pins(sensor, NAMES, scenes, effort.truth)
    finest = set_ring_spacing(sensor, FINEST_MM)
    tight = replace(LEVELS["auto"], tolerance=0.02, limit=5000)
    return solve_reference_pins(finest, NAMES, scenes, tight)


def _describe_failure(contacts: Contacts, rms_px: float, setting: Setting) -> str:
    """Say why a row counts as a failure; empty if it does not."""
    if not np.isfinite(contacts.pins).all():
        count = int(np.sum(~np.isfinite(contacts.pins).all(axis=(1, 2))))
        return f"{count} of {len(contacts.pins)} states are not finite"
    if not contacts.converged.all():
        count = int(np.sum(~contacts.converged))
        return f"{count} of {len(contacts.pins)} states do not converge, rms error {rms_px:.2g} px"
    if rms_px > WRONG_PX and setting.solver != OWN_SOLVER:
        return f"converges to something else: rms error {rms_px:.2g} px"
    return ""


def format_table(rows: Sequence[Json]) -> str:
    """Format rows for people, slides before taps."""
    ordered = sorted(rows, key=lambda row: KINDS.index(row["kind"]))
    return "\n".join([format_text_table(ordered, COLUMNS), "", *_describe_gains(rows)])


def _describe_gains(rows: Sequence[Json]) -> Iterator[str]:
    """Say what `auto` at batch 64 gains over the same level with nothing left out.

    Both must be timed on the same scenes. The row of `auto` among the meshes is, but for small
    efforts its row among the batches is not.
    """
    measured = {(row["kind"], row["name"]): row for row in reversed(rows) if "ratio" in row}
    for kind in KINDS:
        auto = measured.get((kind, f"auto, mesh {RING_MM:g} mm"))
        full = measured.get((kind, "auto, nothing left out, batch 64"))
        if auto and full and auto["timed_scenes"] == full["timed_scenes"]:
            share = auto["ratio"] / full["ratio"]
            yield f"{kind}s: what auto leaves out brings it to {share:.3f} of the time"
