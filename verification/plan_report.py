"""What a contact needs, and what each omission saves (time) and costs (pin error).

print(show_plan(PlannedContact("leaf", (0, 0, 20, 3), move=(2, 1))).text)
print(show_grouping(64).text)
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxunshear.config.outlines import parse_stimulus
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.progress import Progress
from jaxunshear.simulator import systems
from jaxunshear.simulator.contact_results import Contacts
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.input_checks import check_paths
from jaxunshear.simulator.level import OMISSIONS, Level, get_level
from jaxunshear.simulator.paths import DEPTH, YAW, Paths, make_paths
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.scheduler import ContactBatch, Simulation, Stimuli, make_plan
from jaxunshear.simulator.simulate import follow
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
    stimuli: Stimuli
    paths: Paths

    def plan(self, level: Level) -> list[ContactBatch]:
        return make_plan(Simulation(self.sensor, self.stimuli, level), self.paths)

    def solve(self, level: Level) -> Contacts:
        systems.build_system.cache_clear()
        return follow(self.sensor, self.stimuli, self.paths, level, retry=False)[0]


class PlannedContact(NamedTuple):
    """A contact that ends at a pose after a slide and a turn."""

    stimulus: str
    pose: Sequence[float]  # x, y (mm), yaw (deg), depth (mm)
    move: Sequence[float] = (0.0, 0.0)  # mm
    twist: float = 0.0  # deg
    tilt: Sequence[float] = (0.0, 0.0)  # deg
    friction: float | None = None  # None: that of the stimulus

    def make_points(self) -> np.ndarray:
        """Make the way points (3, 6) of the contact."""
        points = np.zeros((3, 6))
        points[:, :4], points[:, 4:] = self.pose, self.tilt
        points[:2, :2] -= self.move
        points[:2, YAW] -= self.twist
        points[0, DEPTH] = min(0.0, self.pose[3])
        return points


def show_plan(
    contact: PlannedContact, level: str = "auto", sensor: Sensor = TACTIP_331
) -> PlanReport:
    """Report what one contact needs, and what each omission saves and costs."""
    stimulus = make_stimulus(parse_stimulus(contact.stimulus))
    friction = stimulus.friction if contact.friction is None else contact.friction
    paths = Paths(np.array([0]), np.array([float(friction)]), contact.make_points()[None])
    settings = get_level(level)
    check_paths(sensor, 1, paths)
    work = _Work(sensor, (stimulus,), paths)
    load_shared_dome(sensor)
    with Progress("plan", len(OMISSIONS) + 1, unit="omissions") as progress:
        rows = _measure_omissions(work, settings, (*OMISSIONS, TOGETHER), progress)
    batch = work.plan(settings)[0]
    count, contacts = len(load_shared_dome(sensor).nodes), work.solve(settings)
    needs = {
        "omission": "",
        "level": level,
        "touching": bool(len(batch.nodes)),
        "nodes": len(batch.nodes),
        "nodes_of": count,
        "increments": batch.steps,
        "friction": batch.friction,
        "tilted": batch.tilted,
        "precision": settings.precision,
        "converged": bool(contacts.converged[0]),
        "residual_mm": float(contacts.residual_mm[0]),
        "iterations": int(contacts.iterations[0]),
    }
    title = f"{stimulus.name}, friction {friction:g}, level {level}, {sensor.name}"
    lines = [title, *_format_needs(needs), "", *_format_table(rows)]
    return PlanReport([needs, *rows], "\n".join(lines))


def show_grouping(
    count: int,
    level: str = "auto",
    sensor: Sensor = TACTIP_331,
    scenes: Callable[[str, int], Scenes] = sample_paper_scenes,
) -> PlanReport:
    """Report how `count` random slides and as many taps of the paper share batches.

    It also says what sharing batches by need saves.
    """
    if count < 1:
        raise UserError(f"--scenes {count}: show at least 1")
    settings = get_level(level)
    rows: list[Json] = []
    lines = []
    for kind in KINDS:
        work = _Work(sensor, NAMES, make_paths(scenes(kind, count)))
        batches = work.plan(settings)
        alone = []  # nodes that each scene needs by itself
        for i in range(count):
            scene = work._replace(paths=work.paths.take(np.array([i])))
            alone.append(len(scene.plan(settings)[0].nodes))
        lines += [
            f"{count} {kind}s, level {level}: {len(batches)} batches",
            "  scenes  nodes  of its scenes  increments  contact",
        ]
        for batch in batches:
            row = _describe_batch(batch, kind, [alone[i] for i in batch.rows])
            rows.append(row)
            lines.append(_format_batch(row))
        with Progress(f"{kind}s", 1, unit="omissions") as progress:
            omissions = _measure_omissions(work, settings, ("grouping",), progress)
        rows += [{**row, "kind": kind} for row in omissions]
        lines += ["", *_format_table(omissions), ""]
    return PlanReport(rows, "\n".join(lines))


def _describe_batch(batch: ContactBatch, kind: str, nodes: list[int]) -> Json:
    """Describe a batch whose scenes need so many `nodes` by themselves."""
    return {
        "omission": "",
        "kind": kind,
        "scenes": len(batch.rows),
        "nodes": len(batch.nodes),
        "nodes_least": min(nodes),
        "nodes_most": max(nodes),
        "increments": batch.steps,
        "friction": batch.friction,
        "tilted": batch.tilted,
    }


def _format_batch(row: Json) -> str:
    contact = _format_contact(row["nodes"] > 0, row["friction"], row["tilted"])
    return (
        f"  {row['scenes']:6}  {row['nodes']:5}  {row['nodes_least']:5} to {row['nodes_most']:<5}  "
        f"{row['increments']:10}  {contact}"
    )


def _measure_omissions(
    work: _Work, level: Level, omissions: Sequence[str], progress: Progress
) -> list[Json]:
    """Switch off omissions one by one; one that does not change the plan is not timed."""
    usual_s, usual = _time_plan(work, level)
    rows = []
    for omission in omissions:
        others = () if omission == TOGETHER else tuple(o for o in level.omit if o != omission)
        less = replace(level, omit=others)
        row: Json = {"omission": omission, "made": less.omit != level.omit, "matters": False}
        if row["made"] and not _is_same(work.plan(level), work.plan(less)):
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
    """Time warm runs, each with its systems built anew, and take their median."""
    contacts = work.solve(level)
    spent = [time_call(lambda: work.solve(level))]
    while len(spent) < REPEATS and sum(spent) < BUDGET_S:
        spent.append(time_call(lambda: work.solve(level)))
    return float(np.median(spent)), contacts


def _is_same(some: list[ContactBatch], others: list[ContactBatch]) -> bool:
    """Say whether two plans solve the same batches."""
    if len(some) != len(others):
        return False
    for batch, other in zip(some, others, strict=True):
        equal = [np.array_equal(batch[i], other[i]) for i in range(len(batch))]
        if not all(equal):
            return False
    return True


def _format_contact(touching: bool, friction: bool, tilted: bool) -> str:
    if not touching:
        return "nothing is touched"
    unknowns = "friction: three unknowns a node" if friction else "no friction: one unknown a node"
    return unknowns + (", tilted" if tilted else "")


def _format_needs(needs: Json) -> list[str]:
    contact = _format_contact(needs["touching"], needs["friction"], needs["tilted"])
    solved = "yes" if needs["converged"] else "NOT CONVERGED"
    return [
        f"  contact     {contact}",
        f"  nodes       {needs['nodes']} of {needs['nodes_of']}",
        f"  increments  {needs['increments']}",
        f"  precision   {needs['precision']}",
        "  batch       1 scene",
        f"  solved      {solved}, residual {needs['residual_mm']:.2g} mm, "
        f"{needs['iterations']} iterations",
    ]


def _format_table(rows: Sequence[Json]) -> list[str]:
    lines = [f"{'left out':44}  with, ms  without it   saves   rms px  p95 px  max px   rms mm"]
    for row in rows:
        name = f"{row['omission']}: {WORDS[row['omission']]}"
        if not row["made"]:
            lines.append(f"{name:44}  not left out at this level")
        elif not row["matters"]:
            lines.append(f"{name:44}  makes no difference here")
        else:
            lines.append(
                f"{name:44}  {row['ms']:8.3g}  {row['ms_without_it']:10.4g}  "
                f"{100 * row['saves']:4.0f} %  {row['rms_px']:7.3f} "
                f"{row['p95_px']:7.3f} {row['max_px']:7.3f}  {row['rms_mm']:7.4f}"
                + ("" if row["converged"] else "  NOT CONVERGED")
            )
    return lines
