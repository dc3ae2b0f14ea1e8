"""Tables of networks on recordings of a real sensor."""

from collections.abc import Mapping, Sequence
from statistics import fmean

from docs.reading import (
    format_figures,
    format_interval,
    format_line,
    format_range,
    format_seeds,
    load_cells,
    load_locked_scores,
    load_result,
    load_rows,
    load_runs,
    start_table,
)
from jaxunshear.files import Json
from jaxunshear.results.sweep import CellResult

TARGETS = {"y_mm": 2, "Rz_deg": 1}
EDGE_TARGETS = {"y_mm": 3, "z_mm": 3, "Rz_deg": 2}
ROWS = {
    "taps": "taps: pose/tap",
    "slides as recorded": "pose/sheared",
    "**slides unsheared**": "pose/disentangled",
    "slides, by a PoseNet that learnt from labelled slides": "pose/sheared_learnt",
    "difference: unsheared - learnt directly": "difference/sheared_learnt",
}
TASK_ROWS = {
    "taps": "tap",
    "slides as recorded": "sheared",
    "unsheared by a network that learnt from the other task": "others",
    "unsheared by a network of the task alone": "own",
    "**unsheared by the joint network**": "unsheared",
    "slides, by a PoseNet that learnt from labelled slides": "sheared_learnt",
}
TAPS_ALONE_ROWS = {
    "as recorded": "sheared",
    "unsheared, nothing known of the task": "nothing",
    "**unsheared, taps of the task known**": "taps alone",
    "unsheared, slides of the task known": "slides",
}
CONTACT_ROWS = {
    "taps": "tap",
    "**slides unsheared**": "unsheared",
    "slides, directly": "sheared_learnt",
}
TASK_TITLES = {"edge_2d": "edge", "surface_3d": "surface"}
OTHER = "other recordings (locked)"
WAYS = {
    "as it is": "as it is",
    "adapted": "**adapted by 50 taps**",
}
SHARES = ("0.01", "0.05", "0.1", "0.3", "1.0")
UNLABELLED = ("left_out", "pseudo_label")
LEARNT = (
    "direct",
    "unsheared",
    "direct, rotation",
    "unsheared, rotation and pseudo-labels",
)
BENCHMARK_ROWS = {
    "slides as recorded, by a PoseNet that learnt from taps": "sheared",
    "slides unsheared, by the same PoseNet": "disentangled",
    "slides, by a PoseNet that learnt from labelled slides": "sheared_learnt",
}
SURFACE_ROWS = {
    "slides as recorded, by a PoseNet that learnt from taps": "sheared",
    "slides unsheared, by the same PoseNet": "own",
    "slides unsheared by a network of both sets, by the same PoseNet": "unsheared",
    "slides, by a PoseNet that learnt from labelled slides": "sheared_learnt",
}
SOURCES = {"simulated": "simulated slides", "rendered": "recorded slides"}
PAIRINGS = {
    "rendered": "what a renderer draws at its pose",
    "nearest": "the nearest tap, weighted by the gap",
}


def _name_target(target: str) -> str:
    return target.replace("_", ", ")


def tabulate_real_skin(modality: str) -> str:
    """Tabulate errors on a real sensor: same session with intervals, and other recordings."""
    metrics = load_cells(f"recorded_{modality}")[0].metrics
    locked = load_locked_scores(f"recorded_{modality}_seed0")
    heads = [f"{_name_target(target)}: same session | {OTHER}" for target in TARGETS]
    lines = start_table(format_line(f"{modality}: a PoseNet that learnt from taps reads", heads))
    for label, key in ROWS.items():
        cells = []
        for target, digits in TARGETS.items():
            same_session = format_interval(metrics[f"{key}/{target}"], digits)
            cells.append(f"{same_session} | {_get_locked(locked, key, target):.{digits}f}")
        lines.append(format_line(label, cells))
    recoveries = []
    for target in TARGETS:
        same_session = format_interval(metrics[f"pose_recovery/disentangled/{target}"], 2)
        recoveries.append(f"{same_session} | {locked[f'pose_recovery.disentangled.{target}']:.2f}")
    lines.append(format_line("recovery: the share of the slide's damage undone", recoveries))
    return "\n".join(lines)


def tabulate_other_recordings() -> str:
    """Tabulate errors of one training over pins, and what its half-widths hold, on two tests."""
    metrics = load_cells("recorded_pins")[0].metrics
    locked = load_locked_scores("recorded_pins_seed0")
    heads = [f"{_name_target(target)}: same session | {OTHER}" for target in EDGE_TARGETS]
    lines = start_table(format_line("pins, seed 0", heads))
    for label, key in list(ROWS.items())[:4]:
        cells = []
        for target, digits in EDGE_TARGETS.items():
            same_session = metrics[f"{key}/{target}"].per_seed["0"]
            other = _get_locked(locked, key, target)
            cells.append(f"{same_session:.{digits}f} | {other:.{digits}f}")
        lines.append(format_line(label, cells))
    coverages = []
    for target in EDGE_TARGETS:
        same_session = metrics[f"coverage/unsheared/{target}"].per_seed["0"]
        other = locked[f"coverage.unsheared.{target}"]
        coverages.append(f"{same_session:.1%} | {other:.1%}")
    lines.append(format_line("95 % half-widths of slides unsheared hold", coverages))
    return "\n".join(lines)


def tabulate_tasks() -> str:
    """Tabulate errors on each task of runs about several, by network: mean and range of seeds."""
    runs = _load_tasks()
    heads, columns = [], []
    for test, table in runs[0].items():
        for target in table["pose_mae"]["unsheared"]:
            heads.append(f"{TASK_TITLES[test]}: {_name_target(target)}")
            columns.append((test, target))
    lines = start_table(format_line("a PoseNet of the task reads", heads))
    for label, kind in TASK_ROWS.items():
        lines.append(format_line(label, [_format_task(runs, *each, kind) for each in columns]))
    return "\n".join(lines)


def tabulate_taps_alone() -> str:
    """Tabulate errors on a task by what a network knew of it: mean and range of seeds."""
    runs = load_runs("taps_alone")
    columns = [
        (row["task"], target)
        for row in runs[0].values()
        if row["name"].endswith("/sheared")
        for target in row
        if target.endswith(("_mm", "_deg"))
    ]
    heads = [f"{TASK_TITLES[task]}: {_name_target(target)}" for task, target in columns]
    lines = start_table(format_line("slides", heads))
    for label, kind in TAPS_ALONE_ROWS.items():
        cells = []
        for task, target in columns:
            values = [run[f"{task}/{kind}"][target] for run in runs]
            cells.append(format_range(values, 3 if target.endswith("_mm") else 2))
        lines.append(format_line(label, cells))
    for known in ("taps alone", "slides"):
        cells = []
        for task, target in columns:
            values = [run[f"{task}/{known}"][f"recovery_{target}"] for run in runs]
            cells.append(format_range(values, 2))
        lines.append(format_line(f"recovery: {known} of the task", cells))
    return "\n".join(lines)


def tabulate_contacts(recordings: str) -> str:
    """Tabulate errors over the number of taps and slides: mean and range of seeds."""
    runs = load_runs("contacts", recordings)
    sizes = list(dict.fromkeys(row["contacts"] for row in runs[0].values()))
    targets = [name for name in next(iter(runs[0].values())) if name.endswith(("_mm", "_deg"))]
    lines = start_table(format_line("taps, and as many slides", [f"{size:,}" for size in sizes]))
    for target in targets:
        digits = 3 if target.endswith("_mm") else 2
        for label, kind in CONTACT_ROWS.items():
            values = [[run[f"{size}/{kind}"][target] for run in runs] for size in sizes]
            cells = [format_range(each, digits) for each in values]
            lines.append(format_line(f"{_name_target(target)}: {label}", cells))
    return "\n".join(lines)


def tabulate_adapted() -> str:
    """Tabulate errors on moved images of a run as it is and adapted: means of the seeds."""
    runs = load_runs("adapt")
    heads = [*map(_name_target, EDGE_TARGETS), "z within the 95 % half-widths"]
    lines = start_table(format_line("images, and the network", heads))
    for name in runs[0]:
        cells = [_format_mean(runs, name, *each) for each in EDGE_TARGETS.items()]
        held = fmean(run[name]["held_z_mm"] for run in runs)
        lines.append(format_line(_name_move(name), [*cells, f"{held:.0%}"]))
    return "\n".join(lines)


def _name_move(name: str) -> str:
    move, _, way = name.partition("/")
    return f"{move}: {WAYS[way]}" if way else move


def _format_mean(runs: Sequence[Mapping[str, Json]], name: str, field: str, digits: int) -> str:
    return f"{fmean(run[name][field] for run in runs):.{digits}f}"


def _load_tasks() -> list[Json]:
    """Return the tests by task of each seed."""
    return [run["tests"] for run in load_result("two_tasks")["runs"].values()]


def _format_task(runs: Sequence[Json], test: str, target: str, kind: str) -> str:
    values = [run[test]["pose_mae"][kind][target] for run in runs]
    return format_range(values, 3 if target.endswith("_mm") else 2)


def tabulate_edge_benchmark() -> str:
    """Tabulate this package's errors on the test slides of the frozen split edge_2d."""
    lines = start_table(format_line("edge_2d", map(_name_target, EDGE_TARGETS)))
    for modality in ("pins", "images"):
        metrics = load_cells(f"recorded_{modality}")[0].metrics
        for label, kind in BENCHMARK_ROWS.items():
            cells = format_figures(metrics, EDGE_TARGETS, f"pose/{kind}/")
            lines.append(format_line(f"{modality}: {label}", cells))
    return "\n".join(lines)


def tabulate_surface_benchmark() -> str:
    """Tabulate this package's errors on the test slides of the frozen split surface_3d."""
    runs = _load_tasks()
    targets = list(runs[0]["surface_3d"]["pose_mae"]["own"])
    lines = start_table(format_line("surface_3d", map(_name_target, targets)))
    for label, kind in SURFACE_ROWS.items():
        cells = [_format_task(runs, "surface_3d", target, kind) for target in targets]
        lines.append(format_line(f"pins: {label}", cells))
    return "\n".join(lines)


def _get_locked(scores: dict[str, float], key: str, target: str) -> float:
    """Return the score of locked recordings that a sweep's results have under `key`."""
    table, kind = key.removeprefix("taps: ").split("/")
    error = scores[f"pose_mae.{kind}.{target}"]
    return scores[f"pose_mae.disentangled.{target}"] - error if table == "difference" else error


def tabulate_few_labels() -> str:
    """Tabulate errors over the share of slides with labels, by what is learnt from."""
    lines = start_table(format_line("slides with a label", LEARNT))
    cells = load_cells("few_labels")
    for share in SHARES:
        errors = []
        for unlabelled in UNLABELLED:
            metrics = next(
                cell.metrics
                for cell in cells
                if f"labelled={share}," in cell.label and f"={unlabelled}:" in cell.label
            )
            for kind in ("sheared_learnt", "disentangled"):
                y_mm = metrics[f"pose/{kind}/y_mm"].mean
                angle_deg = metrics[f"pose/{kind}/Rz_deg"].mean
                errors.append(f"{y_mm:.2f} / {angle_deg:.1f}")
        lines.append(format_line(f"{float(share):.0%}", errors))
    return "\n".join(lines)


def tabulate_pairings() -> str:
    """Tabulate errors by what a slide is paired with."""
    lines = start_table("| a slide's partner | unsheared: y, mm | unsheared: Rz, deg |")
    for cell in load_cells("pairings"):
        name = next(shown for pairing, shown in PAIRINGS.items() if pairing in cell.label)
        errors = format_figures(cell.metrics, TARGETS, "pose/disentangled/")
        lines.append(format_line(name, errors))
    return "\n".join(lines)


def tabulate_simulated_slides() -> str:
    """Tabulate errors on recorded slides by the slides that the network learnt from."""
    targets = {"y_mm": 2, "z_mm": 2, "Rz_deg": 1}
    lines = start_table("| poses of | networks learnt from | y, mm | z, mm | Rz, deg |")
    metrics = {}
    for source in SOURCES:
        metrics[source] = next(
            cell.metrics for cell in load_cells("simulated_slides") if source in cell.label
        )
    for name, key in (("taps", "taps: pose/tap"), ("slides as recorded", "pose/sheared")):
        errors = format_figures(metrics["simulated"], targets, f"{key}/")
        lines.append(format_line(name, ["taps", *errors]))
    kinds = {"disentangled": "slides unsheared", "sheared_learnt": "slides, direct prediction"}
    for key, name in kinds.items():
        for source, shown in SOURCES.items():
            errors = format_figures(metrics[source], targets, f"pose/{key}/")
            lines.append(format_line(name, [f"taps and {shown}", *errors]))
    for source, shown in SOURCES.items():
        digits = dict.fromkeys(targets, 2)
        recoveries = format_figures(metrics[source], digits, "pose_recovery/disentangled/")
        lines.append(format_line("recovery", [f"taps and {shown}", *recoveries]))
    return "\n".join(lines)


def tabulate_transfer() -> str:
    """Tabulate errors on recordings of the weights that learnt in simulation alone.

    Poses are those of their own PoseNet and of a ridge that learnt from recorded taps: means of
    the trainings, each with its least and largest; and of the released weights on other recordings.
    """
    runs, dense_runs = _load_values("skin"), _load_values("dense")
    locked = load_locked_scores("skin")
    estimators = {"pose_mae": "its PoseNet", "readers.pins": "a ridge on recorded taps"}
    columns = [
        (table, target, digits) for table in estimators for target, digits in TARGETS.items()
    ]
    heads = [
        f"{estimators[table]}: {_name_target(target)}: same session | {OTHER}"
        for table, target, _ in columns
    ]
    lines = start_table(format_line("learnt in simulation; reads recorded", heads))
    kinds = {"taps": "tap", "slides as recorded": "sheared", "**slides unsheared**": "unsheared"}
    for label, kind in kinds.items():
        cells = []
        for table, target, digits in columns:
            key = f"{table}.{kind}.{target}"
            values = format_range([run[key] for run in runs], digits)
            cells.append(f"{values} | {locked[key]:.{digits}f}")
        lines.append(format_line(label, cells))
    recoveries = []
    for table, target, _ in columns:
        values = format_range([_compute_recovery(run, table, target) for run in runs], 2)
        recoveries.append(f"{values} | {_compute_recovery(locked, table, target):.2f}")
    lines.append(format_line("recovery: the share of the slide's damage undone", recoveries))
    dense = []
    for table, target, digits in columns:
        key = f"{table}.unsheared.{target}"
        dense.append(f"{format_range([run[key] for run in dense_runs], digits)} | ")
    lines.append(format_line("for comparison: unsheared by dense layers", dense))
    return "\n".join(lines)


def tabulate_released_skin() -> str:
    """Tabulate errors of the released weights on recordings, by two zeros of unsheared outputs."""
    rows = {name: row["value"] for name, row in load_rows("skin_released").items()}
    estimators = {"pose_mae": "its PoseNet", "readers.pins": "a ridge on recorded taps"}
    targets = {"y_mm": 2, "z_mm": 2, "Rz_deg": 1}
    heads = [
        f"{estimators[table]}: {_name_target(name)}" for table in estimators for name in targets
    ]
    lines = start_table(format_line("released weights read", heads))
    kinds = {
        "taps": "tap",
        "slides as recorded": "sheared",
        "slides unsheared, zero of unsheared taps": "unsheared",
        "slides unsheared, zero of taps as recorded": "unsheared_raw_zero",
    }
    for label, kind in kinds.items():
        cells = []
        for table in estimators:
            for target, digits in targets.items():
                value = rows.get(f"{table}.{kind}.{target}")
                cells.append("" if value is None else f"{value:.{digits}f}")
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def _load_values(label_start: str) -> list[dict[str, float]]:
    values = []
    for run in load_runs("skin", label_start):
        values.append({name: row["value"] for name, row in run.items()})
    return values


def _compute_recovery(errors: dict[str, float], table: str, target: str) -> float:
    tap = errors[f"{table}.tap.{target}"]
    sheared = errors[f"{table}.sheared.{target}"]
    return (sheared - errors[f"{table}.unsheared.{target}"]) / (sheared - tap)


def tabulate_rivals(name: str) -> str:
    """Tabulate errors of unsheared and of directly learnt slides, by networks of the same make."""
    return _tabulate_rivals("pins", {cell.label: cell for cell in load_cells(name)})


def tabulate_rival_differences() -> str:
    """Tabulate by how much unsheared poses err more than directly learnt ones, by the test."""
    heads = [_name_target(target) for target in EDGE_TARGETS]
    lines = start_table(format_line("unsheared - direct", heads))
    for name, test in (("rivals", "random tenth"), ("rivals_block", "block of poses")):
        for cell in load_cells(name):
            if cell.label in ("dense", "convolving"):
                errors = format_figures(cell.metrics, EDGE_TARGETS, "difference/sheared_learnt/")
                lines.append(format_line(f"{test}, {cell.label}", errors))
    return "\n".join(lines)


def tabulate_rivals_epochs() -> str:
    """Tabulate the same over images, by how long PoseNets are trained."""
    names = {
        "PoseNets of 7 epochs": "recorded_images",
        "PoseNets of 30 epochs": "rivals_images_chosen",
    }
    cells = {label: load_cells(name)[0] for label, name in names.items()}
    return _tabulate_rivals("images", cells)


def _tabulate_rivals(modality: str, cells: Mapping[str, CellResult]) -> str:
    keys = {
        "unsheared": "pose/disentangled",
        "direct": "pose/sheared_learnt",
        "unsheared - direct": "difference/sheared_learnt",
    }
    heads = [f"{way}: {_name_target(target)}" for way in keys for target in EDGE_TARGETS]
    lines = start_table(format_line(f"recorded, {modality}", heads))
    for label, cell in cells.items():
        errors = []
        for key in keys.values():
            errors += format_figures(cell.metrics, EDGE_TARGETS, f"{key}/")
        lines.append(format_line(label, errors))
    return "\n".join(lines)


def tabulate_rivals_images() -> str:
    """Tabulate errors of slides learnt directly over images, by how the PoseNet is trained."""
    heads = [_name_target(target) for target in EDGE_TARGETS]
    lines = start_table(format_line("direct, recorded images", heads))
    for cell in load_cells("rivals_images"):
        errors = format_figures(cell.metrics, EDGE_TARGETS, "pose/sheared_learnt/")
        lines.append(format_line(cell.label, errors))
    return "\n".join(lines)


def tabulate_joint() -> str:
    """Tabulate pose and slide predicted together from recorded slides, with their half-widths."""
    lines = start_table("| | error | 95 % of errors within | which holds of the test |")
    for name, label in (("recorded_joint", "flat surface"), ("recorded_edge_joint", "edge")):
        (cell,) = load_cells(name)
        for key, error in cell.metrics.items():
            if not key.startswith("pose/sheared_learnt/"):
                continue
            target = key.rpartition("/")[2]
            quantity, unit = target.rsplit("_", 1)
            half_width = cell.metrics[f"half_width/sheared_learnt/{target}"]
            coverage = cell.metrics[f"coverage/sheared_learnt/{target}"]
            cells = [
                f"{format_interval(error, 2)} {unit}",
                f"{half_width.mean:.2f} {unit}",
                format_seeds(coverage),
            ]
            lines.append(format_line(f"{label}: {quantity.replace('_', ' ')}", cells))
    return "\n".join(lines)
