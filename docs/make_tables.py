"""Tables in README and docs, from docs/results: `make tables` puts them into the pages; a test compares.

A table stands where a page has its first line. Under it stands how its files were made (`provenance.py`). For a new table write
a function here, add it to TABLES, write its first line into the page, and call `make tables`.
"""

from collections.abc import Callable, Iterable
from itertools import starmap
from statistics import fmean, median
from typing import Any

from docs import simulator_tables
from docs.provenance import NOTE, ROOT, note
from docs.reading import USED, as_line, runs_of, swept, take, with_interval, with_range
from jaxunshear.evaluation.code_exchange import EXCHANGED, OWN
from jaxunshear.evaluation.paper_results import PAPER
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.run import Results
from jaxunshear.results.sweep import CellResult, Figure

COLUMNS = (("y_mm", 2), ("Rz_deg", 1))
ROWS = {
    "taps": "taps: pose/tap",
    "slides as recorded": "pose/sheared",
    "**slides unsheared**": "pose/disentangled",
    "slides, by a PoseNet that learnt from labelled slides": "pose/sheared_learnt",
    "unsheared less learnt directly": "difference/sheared_learnt",
}
SHARES = ("0.01", "0.05", "0.1", "0.3", "1.0")
WAYS = ("left_out", "read")
LEARNT = (
    "directly",
    "unsheared",
    "directly, pins turned",
    "unsheared, pins turned, the others read",
)
REFITTED = {
    "frame": "the object's frame, found in other contacts",
    "friction": "friction",
    "skin_to_gel": "stiffness, skin : gel",
    "skin_mm": "skin's thickness, mm",
    "pin_length_mm": "pins' length, mm",
    "skin_poisson": "skin's Poisson's ratio",
    "gel_poisson": "gel's Poisson's ratio",
    "dome_radius_mm": "dome's radius, mm",
    "mm_across": "camera: mm across",
    "distance_mm": "camera: distance, mm",
    "all": "all values together",
}
SOURCES = {"simulated": "simulated slides", "rendered": "recorded slides"}
READINGS = {
    "l1:l2=0.0001:0.0001, kernels=sum": "1e-4, of a kernel's sum",
    "l1:l2=0.0001:0.0001, kernels=mean": "1e-4, of a kernel's mean",
    "l1:l2=0.001:0.001, kernels=sum": "1e-3, of a kernel's sum",
    "l1:l2=0.001:0.001, kernels=mean": "**1e-3, of a kernel's mean**",
    "lambda 10": "1e-3, of a kernel's mean; and lambda 10",
}
GRID = (("ms_ssim/disentangled", 3), ("pose/disentangled/edge_mm", 2))
FOUND = {"tactip331-flush": "flush", "tactip331-fitted": "fitted", "tactip331": "levers"}
PARTS = {"all": "all", "sticking": "not all of the skin slips", "slipped": "all of it slips"}
PAIRINGS = {
    "rendered": "what a renderer draws at its pose",
    "nearest": "the nearest tap, weighted by the gap",
}


def sizing() -> str:
    """A simulated set's processor time and storage, measured a contact and multiplied."""
    lines = ["| step | measured, a contact | a million | 10^8, on paper |", "|---|---|---|---|"]
    for row in take("bench_data")["rows"]:
        if row["cpu_ms"] is not None:
            hours = row["cpu_ms"] / 3.6
            lines.append(
                f"| {row['name']}: core | {row['cpu_ms']:.3g} ms | {hours:.2g} h | {100 * hours:.0f} h |"
            )
        if row["bytes"]:
            size = row["bytes"] / 1e3
            lines.append(
                f"| {row['name']}: bytes | {size:.3g} kB | {size:.2g} GB | {size / 10:.2g} TB |"
            )
    return "\n".join(lines)


def waiting() -> str:
    """Steps of training whose examples are there, and whose examples are read and drawn as they go."""
    lines = [
        "| networks over | batch | ms a step, examples there | read and drawn | ratio, median [its interval] | 95 % of turns |",
        "|---|---|---|---|---|---|",
    ]
    for row in take("bench_input")["rows"]:
        times = [f"{row[name]:.1f}" for name in ("ms_there", "ms_drawn")]
        times += [
            f"{row['ratio']:.3f} [{row['ratio_low']:.3f}, {row['ratio_high']:.3f}]",
            f"{row['ratio_p95']:.2f}",
        ]
        lines.append(as_line(row["name"], [str(row["batch"]), *times]))
    return "\n".join(lines)


def pin_networks() -> str:
    """Networks over pins: how long a step and a frame take, and how much longer with plain layers."""
    lines = [
        "| E | what | batch | ms, median | ms, 95 % | plain layers, times as long |",
        "|---|---|---|---|---|---|",
    ]
    for row in take("bench_pinnets")["rows"]:
        times = [f"{row[name]:.2f}" for name in ("ms", "ms_p95", "plain_over_fast")]
        lines.append(as_line(row["name"], [row["what"], str(row["batch"]), *times]))
    return "\n".join(lines)


def found_pins() -> str:
    """Pins of simulated frames: how surely, how exactly and how fast they are found."""
    lines = [
        "| sensor, kind | px | sure | wrong | error, px rms | ms a frame, median (95 %) |",
        "|---|---|---|---|---|---|",
    ]
    rows = take("bench_pins")["rows"]
    for row in sorted(rows, key=lambda row: (-row["size"], list(FOUND).index(row["sensor"]))):
        cells = (f"{row['sure']:.1%}", str(row["wrong"]), f"{row['rms_px']:.3f}")
        spent = f"{row['ms']:.1f} ({row['ms_p95']:.0f})"
        lines.append(
            as_line(f"{FOUND[row['sensor']]}, {row['kind']}", [str(row["size"]), *cells, spent])
        )
    return "\n".join(lines)


def streamed() -> str:
    """Print how long a robot's perception takes for one image, next to PyTorch."""
    columns = ["px", "images", "ms, median", "ms, 99th percentile"]
    lines = [as_line("one image at a time", columns), "|---|" + "---|" * len(columns)]
    for row in take("bench_stream")["rows"]:
        cells = [str(row["size"]), f"{row['steps']:,}"]
        cells += [f"{row[name]:.1f}" for name in ("ms_per_image", "ms_p99")]
        lines.append(as_line(row["name"], cells))
    return "\n".join(lines)


def touched() -> str:
    """Pictures of `explore`: how long they take."""
    lines = [
        "| stimulus | pictures | refused | ms, median | ms, 95 % | ms, most |",
        "|---|---|---|---|---|---|",
    ]
    for row in take("bench_explore")["rows"]:
        times = [f"{row[name]:.0f}" for name in ("ms", "ms_p95", "most_ms")]
        lines.append(as_line(row["name"], [str(row["pictures"]), str(row["refused"]), *times]))
    return "\n".join(lines)


OTHER = "other recordings (locked)"


def real_skin() -> str:
    """Errors over pins and over images: on the own tenth with 95 % intervals, and on other recordings."""
    columns = [(name, q, d) for name in ("pins", "images") for q, d in COLUMNS]
    own = {name: swept(f"recorded_{name}")[0].metrics for name in ("pins", "images")}
    locked = {name: _locked(f"recorded_{name}_seed0") for name in ("pins", "images")}
    head = [f"{name}: {q.replace('_', ', ')}: same session | {OTHER}" for name, q, _ in columns]
    lines = [
        as_line("a PoseNet that learnt from taps reads", head),
        "|---|" + "---|---|" * len(columns),
    ]
    for shown, key in ROWS.items():
        cells = [
            f"{with_interval(own[name][f'{key}/{q}'], d)} | {_locked_value(locked[name], key, q):.{d}f}"
            for name, q, d in columns
        ]
        lines.append(as_line(shown, cells))
    undone = [
        f"{with_interval(own[name][f'pose_recovery/disentangled/{q}'], 2)} | {locked[name][f'pose_recovery.disentangled.{q}']:.2f}"
        for name, q, _ in columns
    ]
    return "\n".join([*lines, as_line("recovery: the share of the slide's damage undone", undone)])


def other_recordings() -> str:
    """Errors of one training over pins on its own tenth and on other recordings, and what its half-widths hold."""
    own, locked = swept("recorded_pins")[0].metrics, _locked("recorded_pins_seed0")
    columns = (("y_mm", 3), ("z_mm", 3), ("Rz_deg", 2))
    head = [f"{q.replace('_', ', ')}: same session | {OTHER}" for q, _ in columns]
    lines = [as_line("pins, seed 0", head), "|---|" + "---|---|" * len(columns)]
    for shown, key in list(ROWS.items())[:4]:
        cells = [
            f"{own[f'{key}/{q}'].per_seed['0']:.{d}f} | {_locked_value(locked, key, q):.{d}f}"
            for q, d in columns
        ]
        lines.append(as_line(shown, cells))
    held = [
        f"{own[f'coverage/unsheared/{q}'].per_seed['0']:.1%} | {locked[f'coverage.unsheared.{q}']:.1%}"
        for q, _ in columns
    ]
    return "\n".join([*lines, as_line("95 % half-widths of slides unsheared hold", held)])


def _locked_value(rows: dict[str, float], key: str, quantity: str) -> float:
    """Find the figure of locked recordings that a sweep's results have under `key`."""
    table, kind = key.removeprefix("taps: ").split("/")
    if table == "difference":
        return rows[f"pose_mae.disentangled.{quantity}"] - rows[f"pose_mae.{kind}.{quantity}"]
    return rows[f"pose_mae.{kind}.{quantity}"]


def demo() -> str:
    """Likeness and errors of the demo over training seeds."""
    (cell,) = swept("demo")
    kinds = ("tap", "sheared", "entangled", "disentangled")
    lines = [f"| `make demo`, simulated | {' | '.join(kinds)} |", "|---|" + "---|" * len(kinds)]
    metrics = cell.metrics
    likeness = ["1", *(with_interval(metrics[f"ms_ssim/{kind}"], 3) for kind in kinds[1:])]
    lines.append(as_line("MS-SSIM to the tap, 128 px (`ms_ssim@4`)", likeness))
    for name, key, digits in (
        ("edge distance error, mm", "edge_mm", 2),
        ("edge angle error, deg", "edge_deg", 1),
    ):
        lines.append(
            as_line(name, [with_interval(metrics[f"pose/{kind}/{key}"], digits) for kind in kinds])
        )
    return "\n".join(lines)


SHOWN = {
    "tap": "tap",
    "sheared": "sheared",
    "translated": "sheared, best translation",
    "mean_tap": "mean training tap",
    "nearest_tap": "nearest training tap",
    "entangled": "entangled",
    "entangled_large": "entangled, as many parameters",
    "unet": "U-Net",
    "disentangled": "disentangled",
    "sheared_learnt": "PoseNet that learnt slides",
}
QUANTITIES = (("x_mm", 2), ("yaw_deg", 1), ("edge_mm", 2), ("edge_deg", 1))


def standard() -> str:
    """Likeness, pins and errors of the standard experiment by what is read."""
    metrics = swept("standard")[0].metrics
    lines = [
        "| | MS-SSIM@4 | pins, px rms | x, mm | yaw, deg | edge distance, mm | edge angle, deg |",
        "|---|---|---|---|---|---|---|",
    ]
    for way, shown in SHOWN.items():
        likeness = (
            with_interval(metrics[f"ms_ssim/{way}"], 3) if f"ms_ssim/{way}" in metrics else ""
        )
        pins = metrics.get(f"pin_error/{way}/rms_px") if way != "sheared" else None
        cells = [
            with_interval(metrics[f"pose/{way}/{name}"], digits) for name, digits in QUANTITIES
        ]
        lines.append(as_line(shown, [likeness, f"{pins.mean:.3f}" if pins else "", *cells]))
    return "\n".join(lines)


def recoveries() -> str:
    """The share of what a slide adds to an error that is gone again, by reader and network."""
    metrics = swept("standard")[0].metrics
    lines = ["| recovery | x | yaw | edge distance | edge angle |", "|---|---|---|---|---|"]
    for way in ("entangled", "entangled_large", "unet", "disentangled", "sheared_learnt"):
        lines.append(
            as_line(
                SHOWN[way],
                [
                    with_interval(metrics[f"pose_recovery/{way}/{name}"], 2)
                    for name, _ in QUANTITIES
                ],
            )
        )
    return "\n".join(lines)


def other_readers() -> str:
    """Errors of the reader that is no neural network, in the standard experiment."""
    metrics = swept("standard")[0].metrics
    lines = [
        "| `pixels` reads | x, mm | yaw, deg | edge distance, mm | edge angle, deg |",
        "|---|---|---|---|---|",
    ]
    for way in ("tap", "sheared", "entangled", "entangled_large", "unet", "disentangled"):
        cells = [
            with_interval(metrics[f"read/pixels/{way}/{name}"], digits)
            for name, digits in QUANTITIES
        ]
        lines.append(as_line(SHOWN[way], cells))
    return "\n".join(lines)


def standard_first() -> str:
    """The first figures of the standard experiment, the paper's beside them."""
    metrics = swept("standard")[0].metrics
    kinds = ("tap", "sheared", "entangled", "disentangled")
    lines = [f"| `standard.py` | {' | '.join(kinds)} |", "|---|" + "---|" * len(kinds)]
    likeness = ["1", *(with_interval(metrics[f"ms_ssim/{kind}"], 3) for kind in kinds[1:])]
    lines.append(as_line("MS-SSIM to the tap, simulated, 128 px (`ms_ssim@4`)", likeness))
    lines.append(as_line("MS-SSIM, real, 256 px (paper, Table 1)", ["1", "0.32", "0.90", "0.93"]))
    for name, key, digits in (
        ("edge distance error, mm", "edge_mm", 2),
        ("edge angle error, deg", "edge_deg", 1),
    ):
        cells = [with_interval(metrics[f"pose/{kind}/{key}"], digits) for kind in kinds]
        lines.append(as_line(f"{name}, simulated", cells))
    return "\n".join(lines)


def few_labels() -> str:
    """Errors over the share of slides with labels, by what is learnt from, unsheared and learnt directly."""
    lines = [f"| slides with a label | {' | '.join(LEARNT)} |", "|---|" + "---|" * len(LEARNT)]
    cells = {cell.label: cell.metrics for cell in swept("few_labels")}
    for share in SHARES:
        found = []
        for way in WAYS:
            (metrics,) = (
                m
                for label, m in cells.items()
                if f"labelled={share}," in label and f"={way}:" in label
            )
            for key in ("sheared_learnt", "disentangled"):
                y, angle = (metrics[f"pose/{key}/{q}"].mean for q, _ in COLUMNS)
                found.append(f"{y:.2f} / {angle:.1f}")
        lines.append(as_line(f"{float(share):.0%}", found))
    return "\n".join(lines)


def pairings() -> str:
    """Errors by what a slide is paired with."""
    lines = ["| a slide's partner | unsheared: y, mm | unsheared: Rz, deg |", "|---|---|---|"]
    for cell in swept("pairings"):
        (name,) = (shown for way, shown in PAIRINGS.items() if way in cell.label)
        lines.append(
            as_line(
                name, [with_interval(cell.metrics[f"pose/disentangled/{q}"], d) for q, d in COLUMNS]
            )
        )
    return "\n".join(lines)


def simulated_slides() -> str:
    """Errors on recorded slides by what the slides were that taught."""
    columns = (("y_mm", 2), ("z_mm", 2), ("Rz_deg", 1))
    lines = ["| read | learnt from | y, mm | z, mm | Rz, deg |", "|---|---|---|---|---|"]
    cells = {
        way: next(c.metrics for c in swept("simulated_slides") if way in c.label) for way in SOURCES
    }
    one = cells["simulated"]
    for name, key in (("taps", "taps: pose/tap"), ("slides as recorded", "pose/sheared")):
        lines.append(
            as_line(name, ["taps", *(with_interval(one[f"{key}/{q}"], d) for q, d in columns)])
        )
    for name, key in (("slides unsheared", "disentangled"), ("slides, directly", "sheared_learnt")):
        for way, shown in SOURCES.items():
            found = [with_interval(cells[way][f"pose/{key}/{q}"], d) for q, d in columns]
            lines.append(as_line(name, [f"taps and {shown}", *found]))
    for way, shown in SOURCES.items():
        found = [
            with_interval(cells[way][f"pose_recovery/disentangled/{q}"], 2) for q, _ in columns
        ]
        lines.append(as_line("recovery", [f"taps and {shown}", *found]))
    return "\n".join(lines)


def tenth() -> str:
    """Likeness on a tenth of the paper's data, against both kinds of taps."""
    metrics = swept("paper_tenth")[0].metrics
    ways = ("sheared", "mean_tap", "translated", "entangled", "disentangled")
    lines = [
        f"| MS-SSIM to the tap | {' | '.join(SHOWN[way] for way in ways)} |",
        "|---|" + "---|" * len(ways),
    ]
    for shown, test in (
        ("off by up to 1 mm, as in training", ""),
        ("of the slide's own depth", "depth_0mm: "),
    ):
        lines.append(
            as_line(
                f"taps {shown}", [with_interval(metrics[f"{test}ms_ssim/{way}"], 3) for way in ways]
            )
        )
    return "\n".join(lines)


def tenth_poses() -> str:
    """Errors of poses on a tenth of the paper's data, at the slide's own depth, by two readers, and the paper's of real skin."""
    metrics = swept("paper_tenth")[0].metrics
    ways, three = ("tap", "sheared", "entangled", "disentangled"), QUANTITIES[:3]
    lines = [
        "| | PoseNet reads: x, mm | yaw, deg | edge distance, mm | a ridge reads: x, mm | yaw, deg | edge distance, mm |",
        "|---|---|---|---|---|---|---|",
    ]
    for way in ways:
        keys = [
            (f"depth_0mm: {reader}/{way}/{q}", d)
            for reader in ("pose", "read/pixels")
            for q, d in three
        ]
        lines.append(as_line(way, [with_interval(metrics[key], digits) for key, digits in keys]))
    for way in ways:
        x, yaw = PAPER["pose_mae"][way].values()
        lines.append(
            as_line(f"{way}, real (paper, Table 2)", [f"{x:.2f}", f"{yaw:.1f}", "", "", "", ""])
        )
    return "\n".join(lines)


def short() -> str:
    """Likeness and edges at the paper's resolution, as PoseNet and a ridge on pixels read them."""
    results = convert_record(take("paper_short"), Results, "paper_short.json", "make it again")
    spread, edge = results.spread, QUANTITIES[2:]
    lines = [
        "| | MS-SSIM | PoseNet reads: edge distance, mm | edge angle, deg | a ridge reads: edge distance, mm | edge angle, deg |",
        "|---|---|---|---|---|---|",
    ]
    readers = (
        (results.pose_mae, spread.pose_mae),
        (results.readers["pixels"], spread.readers["pixels"]),
    )
    for way in ("tap", "sheared", "disentangled"):
        likeness = (
            ""
            if way == "tap"
            else with_interval(
                Figure(results.ms_ssim[way]["overall"], spread.ms_ssim[way]["overall"]), 3
            )
        )
        errors = [
            with_interval(Figure(mean[way][q], ends[way][q]), digits)
            for mean, ends in readers
            for q, digits in edge
        ]
        lines.append(as_line(SHOWN[way], [likeness, *errors]))
    return "\n".join(lines)


def exported_speed() -> str:
    """A frame's time as our own stream takes it and as an exported file does."""
    rows = take("bench_stream_onnx")["rows"]
    names = {"jaxunshear": "`stream`", "onnxruntime": "the exported file"}
    lines = ["| a frame, ms: median (95 %) | 128 px | 256 px |", "|---|---|---|"]
    for name, shown in names.items():
        found = {
            row["size"]: f"{row['ms_per_image']:.1f} ({row['ms_p95']:.1f})"
            for row in rows
            if row["name"] == name
        }
        lines.append(as_line(shown, [found[128], found[256]]))
    return "\n".join(lines)


def transfer() -> str:
    """Errors on recordings of the weights that learnt in simulation alone, by their own PoseNet and by a ridge that learnt recorded taps:
    means of the trainings, each with its least and most; and of the released weights on other recordings."""
    runs, dense = (
        [{name: row["value"] for name, row in run.items()} for run in runs_of("skin", begins)]
        for begins in ("skin", "dense")
    )
    locked = _locked("skin")
    columns = [(reader, q, d) for reader in ("pose_mae", "readers.pins") for q, d in COLUMNS]
    titles = {"pose_mae": "its PoseNet", "readers.pins": "a ridge on recorded taps"}
    head = [
        f"{titles[reader]}: {q.replace('_', ', ')}: same session | {OTHER}"
        for reader, q, _ in columns
    ]
    lines = [
        as_line("learnt in simulation; reads recorded", head),
        "|---|" + "---|---|" * len(columns),
    ]
    kinds = {"taps": "tap", "slides as recorded": "sheared", "**slides unsheared**": "unsheared"}
    for shown, kind in kinds.items():
        keys = [(f"{reader}.{kind}.{q}", d) for reader, q, d in columns]
        lines.append(
            as_line(
                shown,
                [f"{with_range(_each(runs, key), d)} | {locked[key]:.{d}f}" for key, d in keys],
            )
        )
    undone = []
    for reader, q, _ in columns:
        keys = [f"{reader}.{kind}.{q}" for kind in kinds.values()]
        own = with_range([_undone(*(run[key] for key in keys)) for run in runs], 2)
        undone.append(f"{own} | {_undone(*(locked[key] for key in keys)):.2f}")
    lines.append(as_line("recovery: the share of the slide's damage undone", undone))
    others = [
        f"{with_range(_each(dense, f'{reader}.unsheared.{q}'), d)} | " for reader, q, d in columns
    ]
    return "\n".join([*lines, as_line("for comparison: unsheared by dense layers", others)])


def _each(runs: list[dict[str, float]], key: str) -> list[float]:
    return [run[key] for run in runs]


def _undone(tap: float, sheared: float, unsheared: float) -> float:
    return (sheared - unsheared) / (sheared - tap)


def refit() -> str:
    """What the simulator gains on contacts kept out, by the object's frame, by each value of the sensor, and by all of them."""
    rows = {row["name"]: row["value"] for row in take("validate_refit")["rows"]}
    lines = [
        "| changed | before | after | R2 gained, taps | R2 gained, slides |",
        "|---|---|---|---|---|",
    ]
    for name, shown in REFITTED.items():
        values = [
            f"{rows[f'{when}.{name}']:.3g}" if f"{when}.{name}" in rows else ""
            for when in ("before", "after")
        ]
        lines.append(
            as_line(
                shown,
                values + [f"{rows[f'gain.r2.{kind}.{name}']:+.3f}" for kind in ("tap", "slide")],
            )
        )
    for when, shown in (("before", "R2 before the refit, frame found"), ("after", "R2 after it")):
        found = [
            rows[f"before.r2.{kind}" if when == "before" else f"r2.{kind}"]
            for kind in ("tap", "slide")
        ]
        lines.append(as_line(shown, ["", "", *(f"{value:.3f}" for value in found)]))
    return "\n".join(lines)


KINDS = ("tap", "sheared", "entangled", "disentangled")
TRAINED = ("disk", "clover", "teardrop")  # shapes that the networks have seen
MADE = ("voronoi", "skin")


def geometry() -> str:
    """Correlation with the true indentation and error in mm by way; of images of no contact the largest height in mm."""
    rows = {row["name"]: row for row in take("geometry")["rows"]}
    lines = [
        f"| correlation / rms error, mm | {' | '.join((*KINDS, 'untouched'))} |",
        "|---|" + "---|" * (len(KINDS) + 1),
    ]
    for way in ("areas", "inverse"):
        found = [rows[f"all/{kind}/{way}"] for kind in KINDS]
        cells = [f"{row['correlation']:.3f} / {row['rmse_mm']:.2f}" for row in found]
        still = rows[f"all/untouched/{way}"]
        nothing = still["largest_mm"] == 0
        cells.append(
            "0 / 0" if nothing else f"{still['correlation']:.3f} / {still['largest_mm']:.2f}"
        )
        lines.append(as_line(f"`{way}`", cells))
    return "\n".join(lines)


WALKED = {
    "true": "true pose",
    "sheared": "sheared, tap PoseNet",
    "entangled": "entangled",
    "disentangled": "disentangled",
    "learnt": "sheared, PoseNet that learnt slides",
}


def _of_walks(rows: list[dict[str, Any]], field: str, digits: int) -> str:
    """Over all walks of all trainings."""
    return with_range([value for row in rows for value in row[field]], digits)


def _shapes(rows: dict[str, dict[str, Any]]) -> dict[str, str]:
    names = dict.fromkeys(row["stimulus"] for row in rows.values())
    return {name: name if name in TRAINED else f"{name} (unseen)" for name in names}


def servo() -> str:
    """How far walks are from the edge, mm: the mean of each walk, over starts and trainings."""
    runs = runs_of("servo")
    lines = [f"| | {' | '.join(WALKED.values())} |", "|---|" + "---|" * len(WALKED)]
    for shape, shown in _shapes(runs[0]).items():
        found = [
            [run[f"{shape}/{way}"] for run in runs if f"{shape}/{way}" in run] for way in WALKED
        ]
        lines.append(as_line(shown, [_of_walks(rows, "walk_mm", 2) for rows in found]))
    return "\n".join(lines)


def servo_pins() -> str:
    """The same of networks over pins, beside those over images."""
    pins, images = runs_of("servo_pins"), runs_of("servo")
    columns = (
        (pins, "disentangled"),
        (images, "disentangled"),
        (images, "sheared"),
        (images, "true"),
    )
    lines = [
        "| | pins, unsheared | images, unsheared | images, sheared | true pose |",
        "|---|---|---|---|---|",
    ]
    for shape, shown in _shapes(pins[0]).items():
        found = [
            [run[name] for run in runs if (name := f"{shape}/{way}") in run]
            for runs, way in columns
        ]
        lines.append(as_line(shown, [_of_walks(rows, "walk_mm", 2) for rows in found]))
    return "\n".join(lines)


def objects() -> str:
    """IoU with the true shape over the full grid, by maker: over starts and trainings."""
    runs, looks = runs_of("reconstruct"), {"disentangled": "unsheared", "sheared": "sheared"}
    lines = [
        "| | " + " | ".join(f"{made}, {shown}" for made in MADE for shown in looks.values()) + " |",
        "|---|" + "---|" * len(MADE) * len(looks),
    ]
    for shape, shown in _shapes(runs[0]).items():
        rows = [
            [run[name] for run in runs if (name := f"{shape}/{made}/{way}") in run]
            for made in MADE
            for way in looks
        ]
        lines.append(as_line(shown, [_of_walks(each, "walk_iou", 2) for each in rows]))
    return "\n".join(lines)


def readings() -> str:
    """Inner kernels, validation loss and likeness by how appendix B is read, means over seeds."""
    lines = [
        '| "10e-4" is | inner kernels: step 75 | 450 | 1,350 | validation loss: step 450 | 1,350 | MS-SSIM@4 |',
        "|---|---|---|---|---|---|---|",
    ]
    rows = take("appendix_b_curves")["rows"]
    for cell in swept("appendix_b"):
        trained = [row for row in rows if row["label"] == cell.label and row["seed"] in cell.seeds]
        assert len(trained) == len(cell.seeds)
        steps = [trained[0]["step"].index(step) for step in (75, 450, 1350)]
        sizes = [fmean(row["inner"][at] for row in trained) for at in steps]
        losses = [fmean(row["validation"]["supervised"][at] for row in trained) for at in steps[1:]]
        shown = [f"{value:.4f}" for value in sizes] + [f"{value:.3f}" for value in losses]
        lines.append(
            as_line(
                READINGS[cell.label],
                [*shown, with_interval(cell.metrics["ms_ssim/disentangled"], 3)],
            )
        )
    return "\n".join(lines)


def lambda_split() -> str:
    """MS-SSIM and edge distance over the weight of the patch loss and the split of the codes; means over seeds."""
    return _grid(lambda cell: [f"{cell.metrics[name].mean:.{digits}f}" for name, digits in GRID])


def lambda_split_leaks() -> str:
    """R2 of MLP probes: pose from z_s, slide from z_p; the seeds' median, as a probe that is off on a few contacts has any R2 below 1."""
    leaks = ("pose from z_s (mlp)/r2", "slide from z_p (mlp)/r2")
    return _grid(
        lambda cell: [f"{median(cell.ablation[name].per_seed.values()):.2f}" for name in leaks]
    )


def _grid(numbers: Callable[[CellResult], list[str]]) -> str:
    """A cell's numbers at its place of the sweep lambda_split."""
    table: dict[str, list[str]] = {}
    for cell in swept("lambda_split"):
        table.setdefault(cell.point[0], []).append(", ".join(numbers(cell)))
    splits = list(dict.fromkeys(cell.point[1] for cell in swept("lambda_split")))
    return "\n".join(
        [
            as_line("lambda", splits),
            "|---|" + "---|" * len(splits),
            *starmap(as_line, table.items()),
        ]
    )


def frontier() -> str:
    """Errors and what they cost: seconds of training and milliseconds an image are medians over seeds."""
    names = (
        "MS-SSIM",
        "pins, mm",
        "edge distance, mm",
        "of sheared",
        "edge angle, deg",
        "training, s",
        "ms",
    )
    lines = [as_line("", names), "|---" * (len(names) + 1) + "|"]
    for cell in swept("frontier"):
        metrics = cell.metrics
        edge, sheared = (metrics[f"pose/{kind}/edge_mm"] for kind in ("disentangled", "sheared"))
        numbers = [
            with_interval(metrics["ms_ssim/disentangled"], 3),
            f"{metrics['pin_error/disentangled/rms_mm'].mean:.3f}",
            with_interval(edge, 2),
            f"{edge.mean / sheared.mean:.2f}",
            with_interval(metrics["pose/disentangled/edge_deg"], 1),
            f"{_train_seconds(cell):.0f}",
            f"{_ms(cell, 'disentangled'):.1f}",
        ]
        lines.append(as_line(cell.label, numbers))
    return "\n".join(lines)


def perception() -> str:
    """Milliseconds an image to unshear it and read its pose, and the errors left."""
    lines = [as_line("", ("ms", "edge distance, mm", "edge angle, deg")), "|---|---|---|---|"]
    for cell in swept("frontier"):
        if not cell.label.startswith("Adam"):
            spent = sum(_ms(cell, name) for name in ("disentangled", "posenet"))
            errors = (cell.metrics[f"pose/disentangled/{name}"] for name in ("edge_mm", "edge_deg"))
            shown = [
                f"{error.mean:.{digits}f}" for error, digits in zip(errors, (2, 1), strict=True)
            ]
            lines.append(as_line(cell.label, [f"{spent:.1f}", *shown]))
    return "\n".join(lines)


def _train_seconds(cell: CellResult) -> float:
    """The median over seeds."""
    return median(costs.train_seconds["disentangled"] for costs in cell.costs.values())


def _ms(cell: CellResult, network: str) -> float:
    """The median over seeds and over all cells of this network: how long it was trained changes nothing."""

    def built(one: CellResult) -> dict[str, str]:
        return {
            name: value for name, value in one.settings.items() if not name.startswith("train.")
        }

    alike = [one for one in swept("frontier") if built(one) == built(cell)]
    return median(
        costs.ms_per_image[network]["median"] for one in alike for costs in one.costs.values()
    )


EDGE = (("y_mm", 3), ("z_mm", 3), ("Rz_deg", 2))
SLIDE = ("slide_x_mm, all", "slide_y_mm, all")
LEAKS = ("slide from z_p", "pose from z_s")


def _leaks(cell: CellResult) -> list[str]:
    """Return R2 and shares of the ceiling of both leaks."""
    cells = []
    for name in LEAKS:
        for field in ("r2", "share", "largest share"):
            cells.append(with_range(list(cell.ablation[f"{name}/{field}"].per_seed.values()), 2))
    return cells


def rivals() -> str:
    return _compare_rivals("rivals")


def rivals_block() -> str:
    """Print the same table for a block of poses that was kept out."""
    return _compare_rivals("rivals_block")


def _compare_rivals(name: str) -> str:
    """Print errors of unsheared and of directly learnt slides, by networks of the same make."""
    ways = {
        "unsheared": "pose/disentangled",
        "direct": "pose/sheared_learnt",
        "unsheared - direct": "difference/sheared_learnt",
    }
    head = [f"{way}: {quantity.replace('_', ', ')}" for way in ways for quantity, _ in EDGE]
    lines = [as_line("recorded, pins", head), "|---|" + "---|" * len(head)]
    for cell in swept(name):
        cells = [
            with_interval(cell.metrics[f"{key}/{quantity}"], digits)
            for key in ways.values()
            for quantity, digits in EDGE
        ]
        lines.append(as_line(cell.label, cells))
    return "\n".join(lines)


def parted_pins() -> str:
    """Likeness, pins and edge errors of the same networks; what DS draws of exchanged codes and of a contact's own."""
    drawn = ("DS, codes exchanged/rms_px", "DS, codes both of its own/rms_px")
    lines = [
        "| | MS-SSIM@4 | pins, px rms | edge distance, mm | edge angle, deg | DS, codes exchanged, px | of its own, px |",
        "|---|---|---|---|---|---|---|",
    ]
    cells = swept("parted")
    found = cells[0].metrics
    for kind in ("tap", "sheared"):
        likeness = with_interval(found["ms_ssim/sheared"], 3) if kind == "sheared" else "1"
        pins = with_interval(found["pins/sheared"], 2) if kind == "sheared" else "0"
        errors = [
            with_interval(found[f"pose/{kind}/{name}"], digits) for name, digits in QUANTITIES[2:]
        ]
        lines.append(as_line(kind, [likeness, pins, *errors, "", ""]))
    for cell in cells:
        found, spoilt = cell.metrics, cell.ablation
        likeness, pins = (
            with_interval(found["ms_ssim/disentangled"], 3),
            with_interval(found["pins/disentangled"], 2),
        )
        errors = [
            with_interval(found[f"pose/disentangled/{name}"], digits)
            for name, digits in QUANTITIES[2:]
        ]
        shown = [with_range(list(spoilt[name].per_seed.values()), 2) for name in drawn]
        lines.append(as_line(cell.label, [likeness, pins, *errors, *shown]))
    return "\n".join(lines)


def parted_skin() -> str:
    """Print R2 of the strongest probe for both leaks of recorded slides, and its share of the ceiling."""
    head = [
        f"{leak}: {field}"
        for leak in LEAKS
        for field in ("R2", "share of ceiling", "largest share")
    ]
    lines = [f"| recorded, pins | {' | '.join(head)} |", "|---|" + "---|" * len(head)]
    lines += [as_line(cell.label, _leaks(cell)) for cell in swept("parted_skin")]
    return "\n".join(lines)


def parted_skin_errors() -> str:
    """Print errors of unsheared recorded slides, and the standard scores of the codes."""
    scores = ("MIG", "SAP", "DCI disentanglement")
    lines = [
        f"| recorded, pins | unsheared: y, mm | z, mm | Rz, deg | slide x, mm | slide y, mm | {' | '.join(scores)} |",
        "|---|" + "---|" * (5 + len(scores)),
    ]
    for cell in swept("parted_skin"):
        errors = [
            with_interval(cell.metrics[f"pose/disentangled/{name}"], digits)
            for name, digits in EDGE
        ]
        slide = [
            with_range(list(cell.ablation[f"{name}/mae"].per_seed.values()), 2) for name in SLIDE
        ]
        figures = [f"{cell.ablation[f'standard scores/{name}'].mean:.2f}" for name in scores]
        lines.append(as_line(cell.label, [*errors, *slide, *figures]))
    return "\n".join(lines)


def joint() -> str:
    """Pose and slide of recorded slides, read together; and what the half-widths of the answers hold, least and most of the seeds."""
    lines = ["| | error | 95 % of errors within | which holds of the test |", "|---|---|---|---|"]
    for name, shown in (("recorded_joint", "flat surface"), ("recorded_edge_joint", "edge")):
        (cell,) = swept(name)
        found = cell.metrics
        for key in [key for key in found if key.startswith("pose/sheared_learnt/")]:
            target = key.rpartition("/")[2]
            quantity, unit = target.rsplit("_", 1)
            width, held = (
                found[f"{table}/sheared_learnt/{target}"] for table in ("half_width", "coverage")
            )
            cells = [
                f"{with_interval(found[key], 2)} {unit}",
                f"{width.mean:.2f} {unit}",
                with_range(list(held.per_seed.values()), 2),
            ]
            lines.append(as_line(f"{shown}: {quantity.replace('_', ' ')}", cells))
    return "\n".join(lines)


def slide_read() -> str:
    """Error and coverage of the slide read from both codes, by whether it has slipped: means of the seeds with least and most."""
    names = ("slide_x_mm", "slide_y_mm", "slide_twist_deg")
    lines = [
        "| codes of | slides | error in x, mm | y, mm | twist, deg | 95 % intervals hold, x | y | twist |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for cell in swept("slide_read"):
        for part, shown in PARTS.items():
            cells = [
                with_range(list(cell.ablation[f"{name}, {part}/{field}"].per_seed.values()), 2)
                for field in ("mae", "coverage")
                for name in names
            ]
            lines.append(as_line(cell.label, [shown, *cells]))
    return "\n".join(lines)


def end_to_end() -> str:
    """Edges read off taps, off unsheared slides, and off slides by a network that learnt them directly; over the tap's, by seed."""
    kinds = {"tap": "tap", "disentangled": "unsheared", "sheared_learnt": "learnt directly"}
    lines = [
        "| poses, pins that are read | MS-SSIM, unsheared | read off | edge distance, mm | edge angle, deg | over the tap's: mm | deg |",
        "|---|---|---|---|---|---|---|",
    ]
    for cell in swept("end_to_end"):
        for prefix, source in (("", "true"), ("found: ", "found")):
            found = {
                kind: [cell.metrics[f"{prefix}pose/{kind}/{name}"] for name, _ in QUANTITIES[2:]]
                for kind in kinds
            }
            for kind, shown in kinds.items():
                first = kind == "tap"
                title = f"{cell.label}, {source}" if first else ""
                likeness = (
                    with_interval(cell.metrics[f"{prefix}ms_ssim/disentangled"], 3)
                    if kind == "disentangled"
                    else ""
                )
                errors = [
                    with_interval(one, digits)
                    for one, (_, digits) in zip(found[kind], QUANTITIES[2:], strict=True)
                ]
                pairs = [
                    zip(a.per_seed.values(), b.per_seed.values(), strict=True)
                    for a, b in zip(found[kind], found["tap"], strict=True)
                ]
                over = (
                    ["", ""]
                    if first
                    else [with_range([one / tap for one, tap in pair], 2) for pair in pairs]
                )
                lines.append(as_line(title, [likeness, shown, *errors, *over]))
    return "\n".join(lines)


def end_to_end_exchanged() -> str:
    """What DS draws of exchanged codes over what it draws of a contact's own, by seed, and by whether the shear code's slide slipped."""
    lines = [
        "| | shear code of | DS, codes exchanged, px | of its own, px | exchanged over own |",
        "|---|---|---|---|---|",
    ]
    for cell in swept("end_to_end")[:1]:
        for part, shown in PARTS.items():
            names = [
                f"DS, codes {name}{'' if part == 'all' else f', {part}'}"
                for name in (EXCHANGED, OWN)
            ]
            drawn = [list(cell.ablation[f"{name}/rms_px"].per_seed.values()) for name in names]
            over = [exchanged / own for exchanged, own in zip(*drawn, strict=True)]
            lines.append(
                as_line(cell.label, [shown, *(with_range(values, 2) for values in (*drawn, over))])
            )
    return "\n".join(lines)


def twisted() -> str:
    """Pins and edge errors on slides that do not twist and that do, by the slides that taught."""
    return _other_slides(
        "twisted",
        {"twist_0deg": "do not twist", "twist_5deg": "by 5 deg", "twist_20deg": "by 20 deg"},
    )


def tilted() -> str:
    """The same of slides of a sensor that stands upright and that leans."""
    return _other_slides("tilted", {"tilt_0deg": "upright", "tilt_25deg": "by up to 25 deg"})


def _other_slides(name: str, tests: dict[str, str]) -> str:
    """Of each test tap, slide and each network; last the errors over those of the first network on the first test, by seed."""
    cells = swept(name)
    lines = [
        "| tested | read, or unsheared by a network of | pins, px rms | edge distance, mm | angle, deg | over the first: mm | deg |",
        "|---|---|---|---|---|---|---|",
    ]
    first = {
        key: cells[0].metrics[f"{next(iter(tests))}: pose/disentangled/{key}"]
        for key, _ in QUANTITIES[2:]
    }
    looks = [("tap", "tap", cells[0]), ("sheared", "sheared", cells[0])]
    looks += [(cell.label, "disentangled", cell) for cell in cells]
    for test, slides in tests.items():
        for shown, kind, cell in looks:
            found = {key: cell.metrics[f"{test}: pose/{kind}/{key}"] for key, _ in QUANTITIES[2:]}
            pins = "0" if kind == "tap" else with_interval(cell.metrics[f"{test}: pins/{kind}"], 2)
            ratios = [
                [found[key].per_seed[seed] / one for seed, one in first[key].per_seed.items()]
                for key in found
            ]
            over = [with_range(each, 2) if kind == "disentangled" else "" for each in ratios]
            lines.append(
                as_line(
                    f"{slides} | {shown}",
                    [pins, *(with_interval(found[k], d) for k, d in QUANTITIES[2:]), *over],
                )
            )
    return "\n".join(lines)


def few_pairs() -> str:
    """Likeness, pins and edge errors by the share of poses whose slides have their tap, and by what teaches beside them; the last three
    as a multiple of the least that any way has with all pairs."""
    cells = sorted(swept("few_pairs"), key=lambda cell: -int(cell.label.partition("%")[0]))
    errors = {"pins/disentangled": 2} | {
        f"pose/disentangled/{name}": digits for name, digits in QUANTITIES[2:]
    }
    complete = [cell.metrics for cell in cells if cell.label.startswith("100%")]
    least = {name: min(metrics[name].mean for metrics in complete) for name in errors}
    lines = [
        "| poses with their tap, what teaches | MS-SSIM@4 | pins, px rms | edge distance, mm | edge angle, deg | times all pairs' |",
        "|---|---|---|---|---|---|",
    ]
    for cell in cells:
        found = cell.metrics
        times = " / ".join(f"{found[name].mean / least[name]:.2f}" for name in errors)
        shown = [with_interval(found[name], digits) for name, digits in errors.items()]
        lines.append(
            as_line(cell.label, [with_interval(found["ms_ssim/disentangled"], 3), *shown, times])
        )
    return "\n".join(lines)


def faults() -> str:
    """What became of the cases of each fault."""
    counts = ("cases", "harmless", "refused", "lost", "silent")
    lines = [
        "| fault | read or done by | cases | harmless | refused by name | lost | silent |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in take("faults")["rows"]:
        lines.append(
            as_line(row["fault"], [row["command"], *(f"{row[name]:,}" for name in counts)])
        )
    return "\n".join(lines)


def _locked(name: str) -> dict[str, float]:
    """Read scores by name that others made on recordings that are not here."""
    return {row["name"]: row["value"] for row in take(f"locked/{name}")["rows"]}


TABLES = {
    "README.md": (real_skin, demo, standard_first),
    "docs/your-own-recordings.md": (pairings, other_recordings, few_labels, simulated_slides),
    "docs/skin.md": (transfer,),
    "docs/unshear-or-directly.md": (rivals, rivals_block),
    "docs/calibration.md": (*simulator_tables.CALIBRATION, refit),
    "docs/simulator.md": simulator_tables.SIMULATOR,
    "docs/applications.md": (
        found_pins,
        geometry,
        servo,
        servo_pins,
        objects,
        streamed,
        perception,
    ),
    "docs/codes.md": (
        parted_skin,
        parted_skin_errors,
        parted_pins,
        end_to_end,
        end_to_end_exchanged,
    ),
    "docs/slides.md": (slide_read, joint),
    "docs/experiments.md": (
        standard,
        recoveries,
        other_readers,
        lambda_split,
        lambda_split_leaks,
        readings,
        tenth,
        tenth_poses,
        frontier,
    ),
    "docs/cluster.md": (sizing,),
    "docs/robot.md": (exported_speed,),
    "docs/explore.md": (touched,),
    "docs/speed.md": (*simulator_tables.SPEED, waiting, pin_networks, short),
    "docs/faults.md": (faults,),
    "docs/limits.md": (few_pairs, twisted, tilted),
}


def with_notes(page: str) -> list[tuple[str, str]]:
    """Return the tables of a page in its order, each with its note."""
    made = []
    for table in TABLES[page]:
        USED.clear()
        text = table()
        made.append((text, note(dict.fromkeys(USED), page)))
    return made


def placed(text: str, tables: Iterable[tuple[str, str]]) -> str:
    """Return the text of a page with each table, and its note, in the place of the table that begins with the same line.

    Of several that begin alike each takes the next one. Raises LookupError if there is none.
    """
    lines, after = text.splitlines(), dict[str, int]()
    for table, under in tables:
        head = table.splitlines()[0]
        try:
            start = lines.index(head, after.get(head, 0))
        except ValueError:
            raise LookupError(
                f"no table is left that begins with {head!r}: write this line where it belongs"
            ) from None
        end = next(
            (at for at in range(start, len(lines)) if not lines[at].startswith("|")), len(lines)
        )
        if lines[end + 1 : end + 2] and lines[end + 1].startswith(NOTE):
            end += 2
        made = [*table.splitlines(), "", under]
        lines[start:end] = made
        after[head] = start + len(made)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    for page in TABLES:
        path = ROOT / page
        before = path.read_text()
        after = placed(before, with_notes(page))
        path.write_text(after)
        print(
            f"{page}: {len(TABLES[page])} tables, {'changed' if after != before else 'as they were'}"
        )
