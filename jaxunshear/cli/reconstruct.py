"""`jaxunshear reconstruct`: complete objects from the walks that `servo` left."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxunshear.cli import options
from jaxunshear.cli.options import Commands, Model, add_model, add_stimulus, new_parser, stimuli_of
from jaxunshear.errors import UserError
from jaxunshear.settings.experiment import simulated_of
from jaxunshear.settings.stimuli import stimulus_names
from jaxunshear.storage import Json

if TYPE_CHECKING:
    from jaxunshear.applications.servo import Walks


def add_parser(commands: Commands) -> None:
    parser = new_parser(
        commands, "reconstruct", "complete objects from the walks that `servo` left", "where they are, and results go"
    )
    add_model(parser)
    add_stimulus(parser)


def run(arguments: argparse.Namespace, out: Path, model: Model) -> Json:
    from jaxunshear.applications import perception
    from jaxunshear.applications.fresh import fresh_contacts
    from jaxunshear.applications.objects import makers_for, objects_of
    from jaxunshear.applications.servo import made_with, stored_walks
    from jaxunshear.report.object_figure import PICTURES, object_figure
    from jaxunshear.storage import write_bytes
    from jaxunshear.table import plain_table

    folder, experiment = model
    paired, _ = simulated_of(experiment, "reconstruct")
    asked = list(stimulus_names(stimuli_of(arguments.stimulus)))
    if arguments.stimulus == "all":  # of outlines of one's own, too
        asked += sorted({file.stem for file in out.glob("*.npz")} - set(asked))
    names = [name for name in asked if (out / f"{name}.npz").is_file()]
    if not names:
        raise UserError(
            f"--out {out} holds no walks: run `jaxunshear servo --model {arguments.model} --out {out}` first"
        )
    if arguments.stimulus != "all" and len(names) < len(asked):
        lacking = ", ".join(name for name in asked if name not in names)
        raise UserError(f"--stimulus {lacking}: {out} holds no walk of it; run `jaxunshear servo` for it first")
    networks = perception.unshearers(folder, experiment, perception.unshearing_of(folder))
    rows: list[Json] = []
    makers: dict[float, Any] = {}  # by depth
    made: dict[tuple[str, ...], str] = {}  # by ways
    for name in names:
        walked = stored_walks(out / f"{name}.npz")
        ways = tuple(dict.fromkeys(walked[1].way.tolist()))
        if ways not in made:
            made[ways] = made_with(experiment.sensor, paired, perception.digests(folder, ways))
        _check_walks(out / f"{name}.npz", walked[1], made[ways])
        depth = walked[0].depth_mm
        if depth not in makers:
            makers[depth] = makers_for(experiment, fresh_contacts(experiment, options.KNOWN, 1, depth))
        found = objects_of(experiment, walked, networks, makers[depth])
        rows += [row for row, _ in found.values()]
        for maker, (file, text) in PICTURES.items():
            solids = {way: solid for (by, way), (_, solid) in found.items() if by == maker}
            write_bytes(out / f"{name}-{file}.png", object_figure(name, solids, text))
        columns = ("name", "walks", "closed", "iou", "iou_felt", "mean_mm", "hausdorff_mm", "height_rms_mm")
        print(plain_table(rows[-len(found) :], columns))
    print(out)
    return {"rows": rows}


def _check_walks(file: Path, walks: "Walks", made: str) -> None:
    """Refuses walks that are not finished, and those of another model."""
    from jaxunshear.applications.servo import WALKING

    if (walks.end == WALKING).any():
        raise UserError(f"{file} holds walks that are not finished: run the same `jaxunshear servo` command again")
    if str(walks.made) != made:
        raise UserError(
            f"{file} holds walks of another model or sensor, or of an earlier simulator: name theirs with --model, or walk again"
        )
