"""Make weights and a model card of a finished run, for `unshear` and `pose`.

>>> release(Path("runs/standard"), Path("weights/standard"))
"""

import json
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from jaxunshear.config.networks import REGISTRY
from jaxunshear.config.serialization import check_finished_run
from jaxunshear.config.stimuli import list_stimulus_names
from jaxunshear.config.targets import to_json
from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.files import read_object, to_builtins, write_json, write_text
from jaxunshear.results.measurement import Machine
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, Results
from jaxunshear.text_table import format_operations

if TYPE_CHECKING:
    from jaxunshear.models.operations import NetworkSize

RELEASED_PARTS = {
    name: kind.released_parts for name, kind in REGISTRY.items() if kind.released_parts is not None
}
ORIGIN_FIELDS = ("origin", "data", "start")  # of the training data, kept with the weights
CARD = "README.md"


def release(run_dir: Path, out: Path) -> Path:
    """Write experiment.json, the trained networks and README.md to `out`, and return `out`.

    Raises `UserError` if `out` exists, or the run is not finished or evaluated.
    """
    from jaxunshear.inference.trained_model import load_model
    from jaxunshear.models.operations import measure_size
    from jaxunshear.training.checkpoint import MODEL, write_weights
    from jaxunshear.training.examples import FRAME

    check_finished_run(run_dir)
    if out.exists():
        raise UserError(f"--out {out} exists: name a new folder")
    settings = read_object(run_dir / "experiment.json")
    results = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY)
    names = [name for name in RELEASED_PARTS if (run_dir / name / MODEL).is_file()]
    if not names:
        raise UserError(f"{run_dir} holds no trained network: name the folder of a finished run")
    trained = load_model(run_dir)
    networks = {name: trained.load_network(name) for name in names}
    sizes = {name: measure_size(each.net, each.variables) for name, each in networks.items()}
    try:
        card = make_card(results, out.name, sizes)
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run_dir / 'results.json'} lacks {error}: {EVALUATE_REMEDY}") from error
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as place:
        part = Path(place) / out.name
        for name, network in networks.items():
            write_weights(part / name, network.variables, RELEASED_PARTS[name])
            model = read_object(run_dir / name / MODEL)
            origin = {key: model[key] for key in ORIGIN_FIELDS if key in model}
            targets = {"targets": to_json(network.targets)}
            write_json(
                part / name / MODEL, {"kind": model["kind"], "net": model["net"]} | targets | origin
            )
        settings |= {"name": out.name}  # that of a sweep's row names its settings
        if results.recordings is not None:
            write_json(part / FRAME, read_object(run_dir / FRAME))
            # paths of recordings are nobody else's, and a table of pairs is not released
            paired = settings["paired"]
            taps = "recorded taps" if paired["tap_folder"] else ""
            paired |= {"tap_folder": taps, "slide_folder": "recorded slides", "pairs": ""}
            if paired["pairing"] == "file":
                paired["pairing"] = "pose_id"
        write_json(part / "experiment.json", settings)
        write_text(part / CARD, card)
        part.rename(out)
    return out


def make_card(results: Results, name: str, sizes: Mapping[str, "NetworkSize"]) -> str:
    """Write the model card in Markdown from the run's results and the sizes of its networks."""
    machines = {_format_machine(machine) for machine in results.trained_on.values()}
    machines -= {_format_machine(results.machine)}
    sources = [source for source in (results.source, *results.trained_by.values()) if source]
    poses, seed = results.counts.test_poses, results.seeds["experiment"]
    paragraphs = [
        f"# {name}",
        results.settings["claim"],
        f"    jaxunshear unshear RECORDINGS --model {name} --out unsheared\n"
        f"    jaxunshear pose RECORDINGS --model {name}",
        f"Networks for {results.settings['unshear']['input']} of {results.metric['image_px']} px; "
        "kernels are stored as float16.",
        _format_sizes(sizes),
        _describe_data(results),
        f"Mean errors at {poses} poses kept out of training (seed {seed}):",
        _format_errors(results),
    ]
    for test_name, test in results.tests.items():
        likeness = test.ms_ssim[choose_main_kind(test.ms_ssim)]["overall"]
        stimuli = ", ".join(test.stimuli)
        paragraphs.append(f"Test `{test_name}` ({stimuli}): likeness {likeness:.3f}.")
    paragraphs += [
        *(f"Trained on: {machine}" for machine in sorted(machines)),
        f"Machine: {_format_machine(results.machine)}",
        *sorted({f"Code: {json.dumps(to_builtins(source))}" for source in sources}),
        f"Versions: {json.dumps(results.versions)}",
    ]
    return "\n\n".join(paragraphs) + "\n"


def _format_sizes(sizes: Mapping[str, "NetworkSize"]) -> str:
    """Format a Markdown table of the parameters and the operations of networks."""
    lines = ["| network, as trained | parameters | FLOPs of a frame |", "|---|---|---|"]
    for name, size in sizes.items():
        lines.append(f"| {name} | {size.parameters:,} | {format_operations(size.operations)} |")
    return "\n".join(lines)


def _format_errors(results: Results) -> str:
    """Format a Markdown table of likeness and errors of poses."""
    targets = list(next(iter(results.pose_mae.values())))
    rows = [["image", "likeness to the tap", *targets], ["---"] * (2 + len(targets))]
    for kind, errors in results.pose_mae.items():
        cells = [results.ms_ssim.get(kind, {}).get("overall"), *map(errors.get, targets)]
        rows.append([kind, *("" if cell is None else f"{cell:.3g}" for cell in cells)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _format_machine(machine: Machine) -> str:
    return json.dumps(to_builtins(replace(machine, kernels=None)))


def _describe_data(results: Results) -> str:
    """Describe what the networks learnt from: recordings, or else simulated contacts."""
    settings, paired, recordings = results.settings, results.settings["paired"], results.recordings
    if recordings is not None:
        labelled = f"{recordings.labelled:.0%} of their labels"
        way = results.pairing.way if results.pairing else "none"
        return (
            f"Learnt from recordings (digest {recordings.digest}) of a sensor with "
            f"{recordings.pins} pins: {recordings.taps['train']} taps and "
            f"{recordings.slides['train']} slides with {labelled}, paired by "
            f"`{way}`; poses are in the frame and the units of the labels. Not measured: another "
            "sensor, object or camera."
        )
    ranges, shapes = paired["ranges"], ", ".join(list_stimulus_names(paired["stimuli"]))
    angles = ""
    for name in ("twist", "tilt"):
        if largest := ranges.get(f"{name}_deg"):
            angles += f", {name} up to {largest:g} deg"
    return (
        f"Learnt from {results.counts.train} pairs of simulated touches (sensor "
        f"`{settings['sensor']['name']}`, shapes {shapes}) by `{results.command}`: poses within "
        f"{ranges['lateral_mm']:g} mm and {ranges['yaw_deg']:g} deg, depths "
        f"{ranges['depth_min_mm']:g} to {ranges['depth_max_mm']:g} mm, slides up to "
        f"{ranges['move_mm']:g} mm{angles}. The errors below are of simulated touches; "
        "`jaxunshear evaluate MODEL --recordings DIR` measures them on a real sensor."
    )
