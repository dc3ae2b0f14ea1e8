"""Command `jaxunshear reconstruct`: objects from the trajectories that `servo` left."""

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
from jaxunshear.config.stimuli import list_stimulus_names
from jaxunshear.errors import UserError
from jaxunshear.results.applications import ObjectScore, ObjectScores

COLUMNS = (
    *("name", "walks", "closed", "iou", "iou_felt"),
    *("mean_mm", "hausdorff_mm", "height_rms_mm"),
)


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
    experiment.paired.get_simulated("reconstruct")  # a model of recordings has no trajectories
    files = _find_trajectory_files(arguments, out)
    rows: list[ObjectScore] = []
    for result in reconstruct(folder, experiment, [load_trajectories(file) for file in files]):
        name = str(result.task.stimulus)
        rows += result.scores
        for method, (file_name, text) in PICTURES.items():
            solids = {way: solid for (by, way), solid in result.objects.items() if by == method}
            write_bytes(out / f"{name}-{file_name}.png", plot_objects(name, solids, text))
        print(format_text_table([vars(row) for row in result.scores], COLUMNS))
    print(out)
    return ObjectScores(rows)


def _find_trajectory_files(arguments: argparse.Namespace, out: Path) -> list[Path]:
    names = list(list_stimulus_names(parse_stimuli(arguments.stimulus)))
    if arguments.stimulus == "all":  # outlines in files, too
        names += sorted({file.stem for file in out.glob("*.npz")} - set(names))
    files = {name: out / f"{name}.npz" for name in names}
    missing = [name for name, file in files.items() if not file.is_file()]
    if len(missing) == len(names):
        raise UserError(
            f"--out {out} holds no walks: "
            f"run `jaxunshear servo --model {arguments.model} --out {out}` first"
        )
    if arguments.stimulus != "all" and missing:
        raise UserError(
            f"--stimulus {', '.join(missing)}: {out} holds no walk of it; "
            "run `jaxunshear servo` for it first"
        )
    return [file for name, file in files.items() if name not in missing]
