"""What a contact needs, what was left out of it, and what each omission saves (time) and costs (pin error).

print(show_plan("leaf", (0, 0, 20, 3), move=(2, 1)).text)
print(show_grouping(64).text)
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxunshear.config.outlines import parse_stimulus as named
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.progress import Progress
from jaxunshear.simulator import batches, systems
from jaxunshear.simulator import simulate as simulator
from jaxunshear.simulator.contact_results import Contacts
from jaxunshear.simulator.input_checks import check_paths, get_level
from jaxunshear.simulator.level import OMISSIONS, Level
from jaxunshear.simulator.obstacle import Obstacles, sample_distances
from jaxunshear.simulator.paths import DEPTH, YAW, Paths, make_paths
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.scheduler import ContactBatch
from jaxunshear.simulator.stimuli import make_stimulus
from verification.clock import time_call
from verification.paper import KINDS, NAMES, sample_paper_scenes
from verification.pin_distance import compute_pin_error

REPEATS, BUDGET_S = 3, 2.0  # warm runs: fewer where they take long
TOGETHER = "all of them"
WORDS = {
    "untouched": "scenes that touch nothing",
    "friction": "friction where there is none",
    "nodes": "nodes out of reach",
    "steps": "steps of short motions",
    "grouping": "waiting for unlike scenes",
    TOGETHER: "the same level with nothing left out",
}


class PlanReport(NamedTuple):
    rows: list[Json]
    text: str


class _Work(NamedTuple):
    """Paths to be planned and timed."""

    sensor: Sensor
    names: batches.Stimuli
    obstacles: Obstacles
    paths: Paths

    def plan(self, level: Level) -> list[ContactBatch]:
        return batches.plan_paths(self.sensor, self.obstacles, self.paths, level, simulator.BATCH)

    def solve(self, level: Level) -> Contacts:
        systems.build_system.cache_clear()
        return simulator.follow(self.sensor, self.names, self.paths, level, retry=False)[0]


def show_plan(
    stimulus: str,
    pose: Sequence[float],
    move: Sequence[float] = (0.0, 0.0),
    twist: float = 0.0,
    tilt: Sequence[float] = (0.0, 0.0),
    friction: float | None = None,
    level: str = "auto",
    sensor: Sensor = TACTIP_331,
) -> PlanReport:
    """One contact that ends at pose (x, y, yaw, depth) after a slide and a turn; friction None: the stimulus' own."""
    touched = make_stimulus(named(stimulus))
    points = np.zeros((3, 6))
    points[:, :4], points[:, 4:] = pose, tilt
    points[:2, :2] -= move
    points[:2, YAW] -= twist
    points[0, DEPTH] = min(0.0, pose[3])
    mu = touched.friction if friction is None else friction
    paths = Paths(np.array([0]), np.array([float(mu)]), points[None])
    how = get_level(level)
    check_paths(sensor, 1, paths)
    work = _Work(sensor, (touched,), sample_distances((touched,)), paths)
    systems.load_shared_dome(sensor)
    with Progress("plan", len(OMISSIONS) + 1, unit="omissions") as progress:
        rows = _omissions(work, how, (*OMISSIONS, TOGETHER), progress)
    batch = work.plan(how)[0]
    count, contacts = len(systems.load_shared_dome(sensor).nodes), work.solve(how)
    needs = {
        "omission": "",
        "level": level,
        "touching": bool(len(batch.nodes)),
        "nodes": len(batch.nodes),
        "nodes_of": count,
        "increments": batch.steps,
        "friction": batch.friction,
        "tilted": batch.tilted,
        "precision": how.precision,
        "converged": bool(contacts.converged[0]),
        "residual_mm": float(contacts.residual_mm[0]),
        "iterations": int(contacts.iterations[0]),
    }
    title = f"{touched.name}, friction {mu:g}, level {level}, {sensor.name}"
    return PlanReport([needs, *rows], "\n".join([title, *_needs(needs), "", *_table(rows)]))


def show_grouping(
    count: int,
    level: str = "auto",
    sensor: Sensor = TACTIP_331,
    scenes: Callable[[str, int], Scenes] = sample_paper_scenes,
) -> PlanReport:
    """How `count` random slides and as many taps (of the paper) share batches, and what sharing by need saves."""
    if count < 1:
        raise UserError(f"--scenes {count}: show at least 1")
    how = get_level(level)
    obstacles = sample_distances(tuple(make_stimulus(name) for name in NAMES))
    rows: list[Json] = []
    lines = []
    for kind in KINDS:
        work = _Work(sensor, NAMES, obstacles, make_paths(scenes(kind, count)))
        batches = work.plan(how)
        alone = [
            len(work._replace(paths=work.paths.take(np.array([i]))).plan(how)[0].nodes)
            for i in range(count)
        ]
        lines += [
            f"{count} {kind}s, level {level}: {len(batches)} batches",
            "  scenes  nodes  of its scenes  increments  contact",
        ]
        for batch in batches:
            own = [alone[i] for i in batch.rows]
            row = {
                "omission": "",
                "kind": kind,
                "scenes": len(batch.rows),
                "nodes": len(batch.nodes),
                "nodes_least": min(own),
                "nodes_most": max(own),
                "increments": batch.steps,
                "friction": batch.friction,
                "tilted": batch.tilted,
            }
            rows.append(row)
            lines.append(
                f"  {row['scenes']:6}  {row['nodes']:5}  {row['nodes_least']:5} to {row['nodes_most']:<5}  {batch.steps:10}  "
                f"{_contact(bool(len(batch.nodes)), batch.friction, batch.tilted)}"
            )
        with Progress(f"{kind}s", 1, unit="omissions") as progress:
            found = _omissions(work, how, ("grouping",), progress)
        rows += [{**row, "kind": kind} for row in found]
        lines += ["", *_table(found), ""]
    return PlanReport(rows, "\n".join(lines))


def _omissions(
    work: _Work, level: Level, omissions: Sequence[str], progress: Progress
) -> list[Json]:
    """A row each. Switched off one by one; what changes nothing in the plan is not timed."""
    usual_s, usual = _time_plan(work, level)
    rows = []
    for omission in omissions:
        less = replace(
            level,
            omit=() if omission == TOGETHER else tuple(o for o in level.omit if o != omission),
        )
        row: Json = {"omission": omission, "made": less.omit != level.omit, "matters": False}
        if row["made"] and not _same(work.plan(level), work.plan(less)):
            spent, contacts = _time_plan(work, less)
            error = compute_pin_error(work.sensor, usual.pins, contacts.pins)
            times = {
                "ms": 1e3 * usual_s,
                "ms_without_it": 1e3 * spent,
                "saves": 1 - usual_s / spent,
            }
            row |= {
                "matters": True,
                **times,
                **error._asdict(),
                "converged": bool(contacts.converged.all()),
            }
        rows.append(row)
        progress.advance(1)
    return rows


def _time_plan(work: _Work, level: Level) -> tuple[float, Contacts]:
    """Median of warm runs, each with its systems set up anew."""
    contacts = work.solve(level)
    spent = [time_call(lambda: work.solve(level))]
    while len(spent) < REPEATS and sum(spent) < BUDGET_S:
        spent.append(time_call(lambda: work.solve(level)))
    return float(np.median(spent)), contacts


def _same(some: list[ContactBatch], others: list[ContactBatch]) -> bool:
    """Whether two plans solve the same; in what order the nodes are turned does not matter where all else agrees."""
    if len(some) != len(others):
        return False
    pairs = zip(some, others, strict=True)
    return all(
        np.array_equal(a.rows, b.rows)
        and np.array_equal(a.nodes, b.nodes)
        and np.array_equal(a.turn, b.turn)
        and a[3:] == b[3:]
        for a, b in pairs
    )


def _contact(touching: bool, friction: bool, tilted: bool) -> str:
    if not touching:
        return "nothing is touched"
    return (
        "friction: three unknowns a node" if friction else "no friction: one unknown a node"
    ) + (", tilted" if tilted else "")


def _needs(needs: Json) -> list[str]:
    return [
        f"  contact     {_contact(needs['touching'], needs['friction'], needs['tilted'])}",
        f"  nodes       {needs['nodes']} of {needs['nodes_of']}",
        f"  increments  {needs['increments']}",
        f"  precision   {needs['precision']}",
        "  batch       1 scene",
        f"  solved      {'yes' if needs['converged'] else 'NOT CONVERGED'}, residual {needs['residual_mm']:.2g} mm, "
        f"{needs['iterations']} iterations",
    ]


def _table(rows: Sequence[Json]) -> list[str]:
    lines = [f"{'left out':44}  with, ms  without it   saves   rms px  p95 px  max px   rms mm"]
    for row in rows:
        name = f"{row['omission']}: {WORDS[row['omission']]}"
        if not row["made"]:
            lines.append(f"{name:44}  not left out at this level")
        elif not row["matters"]:
            lines.append(f"{name:44}  makes no difference here")
        else:
            lines.append(
                f"{name:44}  {row['ms']:8.3g}  {row['ms_without_it']:10.4g}  {100 * row['saves']:4.0f} %  {row['rms_px']:7.3f} "
                f"{row['p95_px']:7.3f} {row['max_px']:7.3f}  {row['rms_mm']:7.4f}"
                + ("" if row["converged"] else "  NOT CONVERGED")
            )
    return lines
