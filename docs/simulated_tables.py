"""Tables of networks on simulated contacts."""

from collections.abc import Callable, Iterator
from itertools import starmap
from statistics import fmean, median

from docs.reading import (
    EDGE_TARGETS,
    KINDS,
    TARGETS,
    format_figures,
    format_interval,
    format_line,
    format_range,
    format_ratio,
    load_cells,
    load_result,
    load_runs,
    start_table,
)
from jaxunshear.evaluation.measurements import PAPER
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.run import Results
from jaxunshear.results.sweep import CellResult, Figure, Figures

REGULARISATION = {
    "l1:l2=0.0001:0.0001, kernels=sum": "1e-4, of a kernel's sum",
    "l1:l2=0.0001:0.0001, kernels=mean": "1e-4, of a kernel's mean",
    "l1:l2=0.001:0.001, kernels=sum": "1e-3, of a kernel's sum",
    "l1:l2=0.001:0.001, kernels=mean": "**1e-3, of a kernel's mean**",
    "lambda 10": "1e-3, of a kernel's mean; and lambda 10",
}
MAIN_KINDS = ("tap", "sheared", "entangled", "disentangled")
LEARNT = ("disentangled", "sheared_learnt")  # unsheared, and read from slides directly
LAYOUTS = {"skin": "rings", "skin127": "hexagonal"}  # of released networks
EDGE_TITLES = {"edge distance error, mm": ("edge_mm", 2), "edge angle error, deg": ("edge_deg", 1)}


def _format_likeness(metrics: Figures) -> list[str]:
    kinds = MAIN_KINDS[1:]
    return ["1", *(format_interval(metrics[f"ms_ssim/{kind}"], 3) for kind in kinds)]


def _format_errors(
    metrics: Figures, kind: str, targets: dict[str, int], table: str = "pose"
) -> list[str]:
    """Format the errors of poses predicted from one kind of image."""
    return format_figures(metrics, targets, f"{table}/{kind}/")


def _list_edge_lines(metrics: Figures, note: str = "") -> Iterator[str]:
    """Yield a line per edge error, with a column per main kind of image."""
    for title, (target, digits) in EDGE_TITLES.items():
        errors = [format_interval(metrics[f"pose/{kind}/{target}"], digits) for kind in MAIN_KINDS]
        yield format_line(title + note, errors)


def tabulate_demo() -> str:
    """Tabulate likeness and errors of the demo over training seeds."""
    (cell,) = load_cells("demo")
    lines = start_table(format_line("`make demo`, simulated", MAIN_KINDS))
    likeness = _format_likeness(cell.metrics)
    lines.append(format_line("MS-SSIM to the tap, 128 px (`ms_ssim@4`)", likeness))
    return "\n".join([*lines, *_list_edge_lines(cell.metrics)])


def tabulate_standard() -> str:
    """Tabulate likeness, pins and errors of the standard experiment by kind of image."""
    metrics = load_cells("standard")[0].metrics
    lines = start_table(
        "| | MS-SSIM@4 | pins, px rms | x, mm | yaw, deg | edge distance, mm | edge angle, deg |"
    )
    for kind, label in KINDS.items():
        likeness = metrics.get(f"ms_ssim/{kind}")
        pins = metrics.get(f"pin_error/{kind}/rms_px") if kind != "sheared" else None
        cells = [
            format_interval(likeness, 3) if likeness else "",
            f"{pins.mean:.3f}" if pins else "",
            *_format_errors(metrics, kind, TARGETS),
        ]
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def tabulate_recoveries() -> str:
    """Tabulate the share of a slide's damage that is undone, by network."""
    metrics = load_cells("standard")[0].metrics
    lines = start_table("| recovery | x | yaw | edge distance | edge angle |")
    digits = dict.fromkeys(TARGETS, 2)
    for kind in ("entangled", "entangled_large", "unet", "disentangled", "sheared_learnt"):
        recoveries = _format_errors(metrics, kind, digits, "pose_recovery")
        lines.append(format_line(KINDS[kind], recoveries))
    return "\n".join(lines)


def tabulate_ridge() -> str:
    """Tabulate errors of kernel ridge regression in the standard experiment."""
    metrics = load_cells("standard")[0].metrics
    lines = start_table(
        "| `pixels` reads | x, mm | yaw, deg | edge distance, mm | edge angle, deg |"
    )
    for kind in ("tap", "sheared", "entangled", "entangled_large", "unet", "disentangled"):
        errors = _format_errors(metrics, kind, TARGETS, "read/pixels")
        lines.append(format_line(KINDS[kind], errors))
    return "\n".join(lines)


def tabulate_standard_first() -> str:
    """Tabulate the first figures of the standard experiment beside the paper's."""
    metrics = load_cells("standard")[0].metrics
    lines = start_table(format_line("`standard.py`", MAIN_KINDS))
    title = "MS-SSIM to the tap, simulated, 128 px (`ms_ssim@4`)"
    lines.append(format_line(title, _format_likeness(metrics)))
    paper = ["1", "0.32", "0.90", "0.93"]
    lines.append(format_line("MS-SSIM, real, 256 px (paper, Table 1)", paper))
    return "\n".join([*lines, *_list_edge_lines(metrics, ", simulated")])


def tabulate_pad() -> str:
    """Tabulate likeness and errors on the simulated pad, and the share of damage undone."""
    metrics = load_cells("pad")[0].metrics
    digits = {"edge_mm": 2, "edge_deg": 1, "depth_mm": 3}
    lines = start_table(
        "| PoseNet reads | MS-SSIM@4 | edge distance, mm | edge angle, deg | depth, mm |"
    )
    for kind in (*MAIN_KINDS[:2], *LEARNT):
        likeness = metrics.get(f"ms_ssim/{kind}")
        cells = [format_interval(likeness, 3) if likeness else ""]
        lines.append(format_line(KINDS[kind], [*cells, *_format_errors(metrics, kind, digits)]))
    for kind in LEARNT:
        recoveries = _format_errors(metrics, kind, dict.fromkeys(digits, 2), "pose_recovery")
        lines.append(format_line(f"recovery: {KINDS[kind]}", ["", *recoveries]))
    return "\n".join(lines)


def tabulate_layouts() -> str:
    """Tabulate errors of networks that read another layout of pins: means and range of seeds."""
    runs = load_runs("layouts")
    digits = {"edge_mm": 2, "edge_deg": 1, "depth_mm": 3}
    lines = start_table(
        "| network, and what it reads | edge distance, mm: slides | unsheared "
        "| edge angle, deg: slides | unsheared | depth, mm: slides | unsheared |"
    )
    for title in dict.fromkeys(name.rpartition("/")[0] for name in runs[0]):
        network, layout = title.split("/")
        pins = runs[0][f"{title}/edge_mm"]["pins"]
        cells = [
            format_range([run[f"{title}/{target}"][kind] for run in runs], places)
            for target, places in digits.items()
            for kind in ("slides", "unsheared")
        ]
        own = " (its own layout)" if LAYOUTS[network] == layout else ""
        lines.append(format_line(f"`{network}`: {pins} pins, {layout}{own}", cells))
    return "\n".join(lines)


def tabulate_shear_code() -> str:
    """Tabulate likeness, pins and errors with a shear code and without, as standard.py trains."""
    lines = start_table(
        "| unsheared by | MS-SSIM@4 | pins, px rms | x, mm | yaw, deg "
        "| edge distance, mm | edge angle, deg |"
    )
    cells = load_cells("shear_code")
    networks = [("entangled", "entangled", cells[0])]
    networks += [(cell.label, "disentangled", cell) for cell in cells]
    for label, kind, cell in networks:
        metrics = cell.metrics
        likeness = format_interval(metrics[f"ms_ssim/{kind}"], 4)
        pins = f"{metrics[f'pin_error/{kind}/rms_px'].mean:.3f}"
        lines.append(format_line(label, [likeness, pins, *_format_errors(metrics, kind, TARGETS)]))
    return "\n".join(lines)


def tabulate_tenth() -> str:
    """Tabulate likeness on a tenth of the paper's data, against both kinds of taps."""
    metrics = load_cells("paper_tenth")[0].metrics
    kinds = ("sheared", "mean_tap", "translated", "entangled", "disentangled")
    lines = start_table(format_line("MS-SSIM to the tap", [KINDS[kind] for kind in kinds]))
    tests = {"off by up to 1 mm, as in training": "", "of the slide's own depth": "depth_0mm: "}
    for label, test in tests.items():
        likeness = [format_interval(metrics[f"{test}ms_ssim/{kind}"], 3) for kind in kinds]
        lines.append(format_line(f"taps {label}", likeness))
    return "\n".join(lines)


def tabulate_tenth_poses() -> str:
    """Tabulate pose errors on a tenth of the paper's data, by two estimators, and the paper's."""
    metrics = load_cells("paper_tenth")[0].metrics
    targets = {target: TARGETS[target] for target in ("x_mm", "yaw_deg", "edge_mm")}
    lines = start_table(
        "| | PoseNet reads: x, mm | yaw, deg | edge distance, mm "
        "| a ridge reads: x, mm | yaw, deg | edge distance, mm |"
    )
    for kind in MAIN_KINDS:
        posenet = _format_errors(metrics, kind, targets, "depth_0mm: pose")
        ridge = _format_errors(metrics, kind, targets, "depth_0mm: read/pixels")
        lines.append(format_line(kind, [*posenet, *ridge]))
    for kind in MAIN_KINDS:
        x_mm, yaw_deg = PAPER["pose_mae"][kind].values()
        cells = [f"{x_mm:.2f}", f"{yaw_deg:.1f}", "", "", "", ""]
        lines.append(format_line(f"{kind}, real (paper, Table 2)", cells))
    return "\n".join(lines)


def tabulate_short() -> str:
    """Tabulate likeness and edges at the paper's resolution, by PoseNet and by a ridge."""
    results = convert_record(
        load_result("paper_short"), Results, "paper_short.json", "make it again"
    )
    spread = results.spread
    lines = start_table(
        "| | MS-SSIM | PoseNet reads: edge distance, mm | edge angle, deg "
        "| a ridge reads: edge distance, mm | edge angle, deg |"
    )
    estimators = (
        (results.pose_mae, spread.pose_mae),
        (results.readers["pixels"], spread.readers["pixels"]),
    )
    for kind in ("tap", "sheared", "disentangled"):
        likeness = ""
        if kind != "tap":
            figure = Figure(results.ms_ssim[kind]["overall"], spread.ms_ssim[kind]["overall"])
            likeness = format_interval(figure, 3)
        errors = [
            format_interval(Figure(means[kind][target], intervals[kind][target]), digits)
            for means, intervals in estimators
            for target, digits in EDGE_TARGETS.items()
        ]
        lines.append(format_line(KINDS[kind], [likeness, *errors]))
    return "\n".join(lines)


def tabulate_regularisation() -> str:
    """Tabulate kernels, validation loss and likeness by how appendix B is read."""
    lines = start_table(
        '| "10e-4" is | inner kernels: step 75 | 450 | 1,350 '
        "| validation loss: step 450 | 1,350 | MS-SSIM@4 |"
    )
    rows = load_result("appendix_b_curves")["rows"]
    for cell in load_cells("appendix_b"):
        trainings = [
            row for row in rows if row["label"] == cell.label and row["seed"] in cell.seeds
        ]
        assert len(trainings) == len(cell.seeds)
        shown = []
        for step in (75, 450, 1350):
            at = trainings[0]["step"].index(step)
            shown.append(f"{fmean(row['inner'][at] for row in trainings):.4f}")
        for step in (450, 1350):
            at = trainings[0]["step"].index(step)
            losses = [row["validation"]["supervised"][at] for row in trainings]
            shown.append(f"{fmean(losses):.3f}")
        likeness = format_interval(cell.metrics["ms_ssim/disentangled"], 3)
        lines.append(format_line(REGULARISATION[cell.label], [*shown, likeness]))
    return "\n".join(lines)


def tabulate_lambda_split() -> str:
    """Tabulate MS-SSIM and edge distance over the weight of the patch loss and the split."""

    def format_cell(cell: CellResult) -> str:
        likeness = cell.metrics["ms_ssim/disentangled"].mean
        return f"{likeness:.3f}, {cell.metrics['pose/disentangled/edge_mm'].mean:.2f}"

    return _tabulate_grid(format_cell)


def _tabulate_grid(format_cell: Callable[[CellResult], str]) -> str:
    """Put each cell of the sweep lambda_split in its place."""
    table: dict[str, list[str]] = {}
    cells = load_cells("lambda_split")
    for cell in cells:
        table.setdefault(cell.point[0], []).append(format_cell(cell))
    splits = list(dict.fromkeys(cell.point[1] for cell in cells))
    lines = start_table(format_line("lambda", splits))
    return "\n".join([*lines, *starmap(format_line, table.items())])


def tabulate_frontier() -> str:
    """Tabulate errors and what they cost: medians over seeds of seconds and milliseconds."""
    heads = (
        *("MS-SSIM", "pins, mm", "edge distance, mm", "of sheared"),
        *("edge angle, deg", "training, s", "ms"),
    )
    lines = start_table(format_line("", heads))
    for cell in load_cells("frontier"):
        metrics = cell.metrics
        edge = metrics["pose/disentangled/edge_mm"]
        seconds = [costs.train_seconds["disentangled"] for costs in cell.costs.values()]
        cells = [
            format_interval(metrics["ms_ssim/disentangled"], 3),
            f"{metrics['pin_error/disentangled/rms_mm'].mean:.3f}",
            format_interval(edge, 2),
            f"{edge.mean / metrics['pose/sheared/edge_mm'].mean:.2f}",
            format_interval(metrics["pose/disentangled/edge_deg"], 1),
            f"{median(seconds):.0f}",
            f"{_compute_ms(cell, 'disentangled'):.1f}",
        ]
        lines.append(format_line(cell.label, cells))
    return "\n".join(lines)


def tabulate_perception() -> str:
    """Tabulate milliseconds per image to unshear it and predict its pose, and the errors left."""
    lines = start_table(format_line("", ("ms", "edge distance, mm", "edge angle, deg")))
    for cell in load_cells("frontier"):
        if not cell.label.startswith("Adam"):
            total_ms = _compute_ms(cell, "disentangled") + _compute_ms(cell, "posenet")
            errors = [
                f"{cell.metrics[f'pose/disentangled/{target}'].mean:.{digits}f}"
                for target, digits in EDGE_TARGETS.items()
            ]
            lines.append(format_line(cell.label, [f"{total_ms:.1f}", *errors]))
    return "\n".join(lines)


def _compute_ms(cell: CellResult, network: str) -> float:
    """Compute the median over the seeds of all cells with this network, however long trained."""
    times = []
    for other in load_cells("frontier"):
        if _get_network_settings(other) == _get_network_settings(cell):
            times += [costs.ms_per_image[network]["median"] for costs in other.costs.values()]
    return median(times)


def _get_network_settings(cell: CellResult) -> dict[str, str]:
    return {name: value for name, value in cell.settings.items() if not name.startswith("train.")}


def tabulate_twisted() -> str:
    """Tabulate pins and edge errors on slides with and without twist, by training slides."""
    tests = {"twist_0deg": "do not twist", "twist_5deg": "by 5 deg", "twist_20deg": "by 20 deg"}
    return _tabulate_tests("twisted", tests)


def tabulate_tilted() -> str:
    """Tabulate pins and edge errors on slides of a sensor that stands upright and that leans."""
    return _tabulate_tests("tilted", {"tilt_0deg": "upright", "tilt_25deg": "by up to 25 deg"})


def _tabulate_tests(name: str, tests: dict[str, str]) -> str:
    """Tabulate each test's taps, slides and networks.

    The last columns are errors over those of the first network on the first test, by seed.
    """
    cells = load_cells(name)
    lines = start_table(
        "| tested | read, or unsheared by a network of | pins, px rms | edge distance, mm "
        "| angle, deg | over the first: mm | deg |"
    )
    images = [("tap", "tap", cells[0]), ("sheared", "sheared", cells[0])]
    images += [(cell.label, "disentangled", cell) for cell in cells]
    for test, slides in tests.items():
        for label, kind, cell in images:
            pins = "0"
            if kind != "tap":
                pins = format_interval(cell.metrics[f"{test}: pins/{kind}"], 2)
            errors, ratios = [], []
            for target, digits in EDGE_TARGETS.items():
                error = cell.metrics[f"{test}: pose/{kind}/{target}"]
                first = cells[0].metrics[f"{next(iter(tests))}: pose/disentangled/{target}"]
                errors.append(format_interval(error, digits))
                ratios.append(format_ratio(error, first) if kind == "disentangled" else "")
            lines.append(format_line(f"{slides} | {label}", [pins, *errors, *ratios]))
    return "\n".join(lines)


def tabulate_few_pairs() -> str:
    """Tabulate likeness, pins and edge errors by the share of poses whose slides have their tap.

    The last column has pins, edge distance and angle as multiples of the least with all pairs.
    """
    cells = sorted(load_cells("few_pairs"), key=lambda cell: -int(cell.label.partition("%")[0]))
    errors = {"pins/disentangled": 2}
    errors |= {f"pose/disentangled/{target}": digits for target, digits in EDGE_TARGETS.items()}
    complete = [cell.metrics for cell in cells if cell.label.startswith("100%")]
    least = {}
    for name in errors:
        least[name] = min(metrics[name].mean for metrics in complete)
    lines = start_table(
        "| poses with their tap, what teaches | MS-SSIM@4 | pins, px rms | edge distance, mm "
        "| edge angle, deg | times all pairs' |"
    )
    for cell in cells:
        names = {"ms_ssim/disentangled": 3} | errors
        shown = format_figures(cell.metrics, names)
        multiples = [f"{cell.metrics[name].mean / least[name]:.2f}" for name in errors]
        lines.append(format_line(cell.label, [*shown, " / ".join(multiples)]))
    return "\n".join(lines)
