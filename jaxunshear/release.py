"""A finished run -> weights to hand on: what unshearing and reading poses take, and a model card that says what they are.

>>> release(Path("runs/standard"), Path("weights/standard"))
"""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.plain import plain
from jaxunshear.results.rows import Machine
from jaxunshear.results.run import EVALUATED, Results
from jaxunshear.results.stored import read
from jaxunshear.settings.registry import DISENTANGLED, POSENET, REGISTRY
from jaxunshear.settings.stimuli import stimulus_names
from jaxunshear.settings.targets import to_json
from jaxunshear.storage import read_object, write_json, write_text

PARTS = {name: kind.released for name, kind in REGISTRY.items() if kind.released is not None}
ORIGINS = ("origin", "data", "start")  # what they learnt from goes with the weights
NEEDED = (DISENTANGLED, POSENET)
CARD = "README.md"
READ = {  # columns of a simulated model's card
    "edge_mm": "edge distance, mm",
    "edge_deg": "edge angle, deg",
    "x_mm": "x, mm",
    "yaw_deg": "yaw, deg",
    "depth_mm": "depth, mm",
    "tilt_x_deg": "tilt about x, deg",
    "tilt_y_deg": "tilt about y, deg",
}


def release(run_dir: Path, out: Path) -> Path:
    """Writes experiment.json, the networks and README.md to `out`, which must not exist. Returns `out`.

    The disentangled network and PoseNet there must be; their rivals come along where the run has trained them.
    Raises `UserError` where the run is not finished or evaluated.
    """
    from jaxunshear.inference.perception import trained
    from jaxunshear.training.checkpoint import MODEL, holds_model, write_weights
    from jaxunshear.training.examples import FRAME

    for name in ("experiment.json", "results.json"):
        if not (run_dir / name).is_file():
            raise UserError(f"{run_dir} holds no {name}: name the folder of a finished run, such as runs/demo")
    if out.exists():
        raise UserError(f"--out {out} exists: name a new folder")
    settings = read_object(run_dir / "experiment.json")
    results = read(run_dir / "results.json", Results, EVALUATED)
    try:
        text, settings = card(results, out.name), settings | {"name": out.name}  # not a sweep's row
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run_dir / 'results.json'} lacks {error}: {EVALUATED}") from error
    needed = NEEDED if results.simulated else ()
    names = [name for name in PARTS if name in needed or holds_model(run_dir / name)]
    if not names:
        raise UserError(f"{run_dir} holds no trained network: name the folder of a finished run")
    _, variables, targets = trained(run_dir, names)
    part = out.with_name(f"{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name in names:
        write_weights(part / name, variables[name], PARTS[name])
        model = read_object(run_dir / name / MODEL)
        origins = {key: model[key] for key in ORIGINS if key in model}
        reported = {"kind": model["kind"], "net": model["net"], "targets": to_json(targets[name])}
        write_json(part / name / MODEL, reported | origins)
    if not results.simulated:
        write_json(part / FRAME, read_object(run_dir / FRAME))
        settings["paired"] |= {
            "tap_folder": "recorded taps" * bool(settings["paired"]["tap_folder"]),
            "slide_folder": "recorded slides",
            "pairs": "",
        }
        if settings["paired"]["pairing"] == "file":  # the table stays with the recordings
            settings["paired"]["pairing"] = "pose_id"
    write_json(part / "experiment.json", settings)
    write_text(part / CARD, text)
    part.rename(out)
    return out


def card(results: Results, name: str) -> str:
    """The model card, in Markdown, all of it from the run's results."""
    return _simulated_card(results, name) if results.simulated else _recorded_card(results, name)


def _made_on(results: Results) -> list[str]:
    """Machines and versions; those that trained are named where they are others than the one that measured."""
    machine = results.machine
    alike = (replace(machine, kernels=None), machine)
    others = {_line(other) for other in results.trained_on.values() if replace(other, kernels=None) not in alike}
    reported = [*(("Trained on", other) for other in sorted(others)), ("Machine", _line(machine))]
    lines = [line for name, text in reported for line in ("", f"{name}: {text}")]
    code = {json.dumps(plain(each)) for each in (results.source, *results.trained_by.values()) if each}
    lines += [line for each in sorted(code) for line in ("", f"Code: {each}")]
    return [*lines, "", f"Versions: {json.dumps(results.versions)}", ""]


def _line(machine: Machine) -> str:
    return json.dumps(plain(machine))


def _slides_of(results: Results) -> str:
    recordings, pairing = results.recorded
    if pairing.way == "simulated":
        return "no slide: those that teach are simulated"
    return f"{recordings.slides['train']} slides, {recordings.labelled:.0%} of the slides' labels"


def _recorded_card(results: Results, name: str) -> str:
    """Of networks that learnt from recordings."""
    metric, counts, (recordings, pairing) = results.metric, results.counts, results.recorded
    targets = [target.name for target in results.targets or ()]
    reads = "pins, found in images" if metric["input"] == "pins" else "images"
    lines = [
        f"# {name}",
        "",
        results.claim,
        "",
        f"Networks for a soft optical tactile sensor of {recordings.pins} pins; they read {reads} of {metric['image_px']} px. "
        "Kernels are stored as float16; the figures below are of the networks as trained.",
        "",
        f"    jaxunshear unshear RECORDINGS --model {name} --out unsheared",
        f"    jaxunshear pose RECORDINGS --model {name}",
        "",
        f"* **Learnt from** recordings (digest {recordings.digest}): {recordings.taps['train']} taps and "
        f"{_slides_of(results)}; pairing: {pairing.way}.",
        f"* **Poses** {', '.join(targets)}, in the names, the frame and the units of the recorded labels.",
        "* **Not measured**: another sensor, another object, another camera.",
        f"* **Seed** {results.seeds['experiment']}.",
        "",
        f"Mean absolute error on recorded contacts kept out of training, {counts.test_taps} taps and {counts.test_poses} slides:",
        "",
        f"| read off | {' | '.join(targets)} |",
        "| --- |" + " --- |" * len(targets),
    ]
    for way, errors in results.pose_mae.items():
        lines.append(f"| {way} | " + " | ".join(f"{errors[target]:.3g}" for target in targets) + " |")
    return "\n".join([*lines, *_made_on(results)])


def _turning(ranges: Mapping[str, float]) -> str:
    """Of slides that twist and sensors that lean, in words."""
    ways = {"twist_deg": "twisting", "tilt_deg": "of a sensor that leans"}
    return "".join(
        f", {reported} by up to {ranges[field]:g} deg" for field, reported in ways.items() if ranges.get(field)
    )


def _simulated_card(results: Results, name: str) -> str:
    settings, metric = results.settings, results.metric
    paired, pose, sensor = settings["paired"], settings["pose"], settings["sensor"]["name"]
    shapes = ", ".join(stimulus_names(paired["stimuli"]))
    given = settings["unshear"]["input"]
    columns = {q: text for q, text in READ.items() if q in results.pose_mae["tap"]}
    lines = [
        f"# {name}",
        "",
        settings["claim"],
        "",
        f"Networks for {given} of a soft optical tactile sensor: Disentangled UnshearNet (encoder, pose code, canonical decoder), "
        "which turns a sheared image into the one that a tap would give, and a PoseNet, which learnt from taps alone. Beside them, "
        "where there is a folder of the name, their rivals: `entangled`, with one code, and `posenet_sheared`, which learnt poses "
        "from slides. Kernels are stored as float16; the figures below are of the network as trained.",
        "",
        f"    jaxunshear unshear RECORDINGS --model {name} --out unsheared",
        f"    jaxunshear pose RECORDINGS --model {name}",
        *([] if given == "pins" else [f"    jaxunshear servo --stimulus disk --model {name}"]),
        "",
        f"* **Learnt from** simulated touches only: sensor `{sensor}`, shapes {shapes}; {results.counts.train} pairs "
        f"and three fifths of {pose['poses'] * len(pose['stimuli'])} taps, the others put aside to validate and to test; images of "
        f"{metric['image_px']} px, {paired['camera']['mm_across']:g} mm across, camera noise {paired['nuisance']['noise']:g}; "
        f"over the set the view drifts by {paired['nuisance']['drift_px']:g} px of the camera's frame in pairs, "
        f"{pose['nuisance']['drift_px']:g} px in taps.",
        f"* **Poses** within {paired['ranges']['lateral_mm']:g} mm, {paired['ranges']['yaw_deg']:g} deg, depths "
        f"{paired['ranges']['depth_min_mm']:g} to {paired['ranges']['depth_max_mm']:g} mm; slides up to "
        f"{paired['ranges']['move_mm']:g} mm along each axis{_turning(paired['ranges'])}. Beyond them nothing is known.",
        f"* **On recordings** of an edge: `jaxunshear evaluate {name} --recordings DIR` measures it."
        if given == "pins"
        else "* **Not measured**: any real sensor. Real images differ from simulated ones (see the documentation of the simulator).",
        f"* **Seed** {results.seeds['experiment']}; made by `{results.command}`.",
        "",
        f"Measured on {results.counts.test} simulated slides at {results.counts.test_poses} poses kept out of training:",
        "",
        f"| image | {metric['ms_ssim']} to the tap | {' | '.join(columns.values())} |",
        "| --- | --- |" + " --- |" * len(columns),
    ]
    for kind in ("tap", "sheared", DISENTANGLED):
        errors = results.pose_mae.get(kind, {})
        likeness = results.ms_ssim.get(kind, {}).get("overall")
        cells = [likeness, *(errors.get(q) for q in columns)]
        lines.append(f"| {kind} | " + " | ".join("" if cell is None else f"{cell:.3g}" for cell in cells) + " |")
    for test, found in results.tests.items():
        likeness = found.ms_ssim[DISENTANGLED]["overall"]
        lines += ["", f"Test `{test}` ({', '.join(found.stimuli)}): {metric['ms_ssim']} {likeness:.3f}."]
    return "\n".join([*lines, *_made_on(results)])
