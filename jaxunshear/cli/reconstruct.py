"""`jaxunshear reconstruct`: complete objects from the walks that `servo` left."""

import argparse
from pathlib import Path

from jaxunshear.cli.options import (
    Commands,
    Model,
    add_model,
    add_results,
    add_stimulus,
    new_parser,
    parse_stimuli,
)
from jaxunshear.config.experiment import require_simulated
from jaxunshear.config.stimuli import list_stimulus_names
from jaxunshear.errors import UserError
from jaxunshear.results.applications import ObjectScore, ObjectScores


def add_parser(commands: Commands) -> None:
    parser = new_parser(
        commands, "reconstruct", "complete objects from the walks that `servo` left"
    )
    add_results(parser, "where they are, and results go")
    add_model(parser)
    add_stimulus(parser)


def run(arguments: argparse.Namespace, out: Path, model: Model) -> ObjectScores:
    from jaxunshear.downstream.object_reconstruction import reconstruct
    from jaxunshear.downstream.servo import load_trajectories
    from jaxunshear.files import write_bytes
    from jaxunshear.report.object_figure import PICTURES, plot_objects
    from jaxunshear.text_table import format_text_table

    folder, experiment = model
    require_simulated(
        experiment, "reconstruct"
    )  # before walks are missed that such a model cannot have made
    asked = list(list_stimulus_names(parse_stimuli(arguments.stimulus)))
    if arguments.stimulus == "all":  # of outlines of one's own, too
        asked += sorted({file.stem for file in out.glob("*.npz")} - set(asked))
    names = [name for name in asked if (out / f"{name}.npz").is_file()]
    if not names:
        raise UserError(
            f"--out {out} holds no walks: run `jaxunshear servo --model {arguments.model} --out {out}` first"
        )
    if arguments.stimulus != "all" and len(names) < len(asked):
        lacking = ", ".join(name for name in asked if name not in names)
        raise UserError(
            f"--stimulus {lacking}: {out} holds no walk of it; run `jaxunshear servo` for it first"
        )
    rows: list[ObjectScore] = []
    for found in reconstruct(
        folder, experiment, [load_trajectories(out / f"{name}.npz") for name in names]
    ):
        name = str(found.task.stimulus)
        rows += found.scores
        for maker, (file, text) in PICTURES.items():
            shown = {way: solid for (by, way), solid in found.objects.items() if by == maker}
            write_bytes(out / f"{name}-{file}.png", plot_objects(name, shown, text))
        columns = (
            "name",
            "walks",
            "closed",
            "iou",
            "iou_felt",
            "mean_mm",
            "hausdorff_mm",
            "height_rms_mm",
        )
        print(format_text_table([vars(row) for row in found.scores], columns))
    print(out)
    return ObjectScores(rows)
