"""Tables of what networks are used for, of the time that takes, and of faults."""

from typing import Any

from docs.reading import (
    format_line,
    format_range,
    load_result,
    load_rows,
    load_runs,
    start_table,
    tabulate_rows,
)

SENSORS = {"tactip331-flush": "flush", "tactip331-fitted": "fitted", "tactip331": "levers"}
GEOMETRY_KINDS = ("tap", "sheared", "entangled", "disentangled")
TRAINING_SHAPES = ("disk", "clover", "teardrop")
TRAJECTORIES = {
    "true": "true pose",
    "sheared": "sheared, tap PoseNet",
    "entangled": "entangled",
    "disentangled": "disentangled",
    "learnt": "sheared, PoseNet that learnt slides",
}

FRAME_ROWS = {
    "jaxunshear, by onnxruntime": "`stream`, with the extra `onnx`",
    "jaxunshear": "`stream`, without it",
    "onnxruntime": "the exported file",
}


def tabulate_detected_pins() -> str:
    """Tabulate how surely, how exactly and how fast pins of simulated frames are found."""
    sensors = list(SENSORS)
    rows = load_result("bench_pins")["rows"]
    ordered = sorted(rows, key=lambda row: (-row["size"], sensors.index(row["sensor"])))
    return tabulate_rows(
        "| sensor, kind | px | sure | wrong | error, px rms | ms a frame, median (95 %) |",
        [row | {"sensor": SENSORS[row["sensor"]]} for row in ordered],
        "{sensor}, {kind}",
        *("{size}", "{sure:.1%}", "{wrong}", "{rms_px:.3f}", "{ms:.1f} ({ms_p95:.0f})"),
    )


def tabulate_lost_pins() -> str:
    """Tabulate how many images of a worn dome are identified, and how exact their pins are.

    Of frames one by one, and of frames from which lost pins are known, it is the worse case.
    """
    rows = {row["name"]: row for row in load_result("bench_lost_pins")["rows"]}
    heads = ("frames identified", "with a wrong pin", "rms error, px")
    kinds = ("simulated", "recorded")
    titles = [f"{kind}: {head}" for kind in kinds for head in heads]
    lines = start_table(format_line("pins lost, dots of dust", titles))
    for name in (name for name in rows if name.startswith("simulated/")):
        cells = []
        for row in (rows[name], rows[name.replace("simulated", "recorded")]):
            wrong = max(row["wrong_alone"], row["wrong"])
            cells += [f"{min(row['alone'], row['sure']):.0%}", str(wrong), f"{row['rms_px']:.2f}"]
        lines.append(format_line("{lost}, {dust}".format_map(rows[name]), cells))
    return "\n".join(lines)


def tabulate_geometry() -> str:
    """Tabulate correlation with the true indentation and error in mm, by method.

    Of images without contact the error is the largest height in mm.
    """
    rows = load_rows("geometry")
    lines = start_table(format_line("correlation / rms error, mm", (*GEOMETRY_KINDS, "untouched")))
    for method in ("areas", "inverse"):
        cells = []
        for kind in GEOMETRY_KINDS:
            row = rows[f"all/{kind}/{method}"]
            cells.append(f"{row['correlation']:.3f} / {row['rmse_mm']:.2f}")
        untouched = rows[f"all/untouched/{method}"]
        if untouched["largest_mm"] == 0:
            cells.append("0 / 0")
        else:
            cells.append(f"{untouched['correlation']:.3f} / {untouched['largest_mm']:.2f}")
        lines.append(format_line(f"`{method}`", cells))
    return "\n".join(lines)


def _label_shapes(rows: dict[str, dict[str, Any]]) -> dict[str, str]:
    names = dict.fromkeys(row["stimulus"] for row in rows.values())
    return {name: name if name in TRAINING_SHAPES else f"{name} (unseen)" for name in names}


def _format_trajectories(runs: list[dict[str, dict[str, Any]]], name: str, field: str) -> str:
    """Format a field over all trajectories of the row `name` of all runs."""
    values = [value for run in runs if name in run for value in run[name][field]]
    return format_range(values, 2)


def tabulate_servo() -> str:
    """Tabulate the distance from the edge in mm: the mean of each trajectory."""
    runs = load_runs("servo")
    lines = start_table(f"| | {' | '.join(TRAJECTORIES.values())} |")
    for shape, label in _label_shapes(runs[0]).items():
        cells = [_format_trajectories(runs, f"{shape}/{way}", "walk_mm") for way in TRAJECTORIES]
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def tabulate_servo_pins() -> str:
    """Tabulate distances from the edge of networks over pins beside those over images."""
    pins, images = load_runs("servo_pins"), load_runs("servo")
    lines = start_table("| | pins, unsheared | images, unsheared | images, sheared | true pose |")
    for shape, label in _label_shapes(pins[0]).items():
        cells = [_format_trajectories(pins, f"{shape}/disentangled", "walk_mm")]
        for way in ("disentangled", "sheared", "true"):
            cells.append(_format_trajectories(images, f"{shape}/{way}", "walk_mm"))
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def tabulate_objects() -> str:
    """Tabulate IoU with the true shape by method, over starts and trainings."""
    runs = load_runs("reconstruct")
    images = {"disentangled": "unsheared", "sheared": "sheared"}
    methods = [(method, image) for method in ("voronoi", "skin") for image in images]
    heads = [f"{method}, {images[image]}" for method, image in methods]
    lines = start_table(f"| | {' | '.join(heads)} |")
    for shape, label in _label_shapes(runs[0]).items():
        cells = [
            _format_trajectories(runs, f"{shape}/{method}/{image}", "walk_iou")
            for method, image in methods
        ]
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def tabulate_stream() -> str:
    """Tabulate how long a robot's perception takes for one image, next to PyTorch."""
    return tabulate_rows(
        "| one image at a time | px | images | ms, median | ms, 99th percentile |",
        load_result("bench_stream")["rows"],
        "{name}",
        *("{size}", "{steps:,}", "{ms_per_image:.1f}", "{ms_p99:.1f}"),
    )


def tabulate_exported_speed() -> str:
    """Tabulate a frame's time as our own stream takes it and as an exported file does."""
    rows = load_result("bench_stream_onnx")["rows"]
    lines = start_table("| a frame, ms: median (95 %) | 128 px | 256 px |")
    for name, label in FRAME_ROWS.items():
        times = sorted((row for row in rows if row["name"] == name), key=lambda row: row["size"])
        cells = [f"{row['ms_per_image']:.1f} ({row['ms_p95']:.1f})" for row in times]
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def tabulate_filter() -> str:
    """Tabulate errors and lags of a stream's poses, without the filter of `stream` and with it."""
    filters = {None: "no", 1.0: "yes"}  # by the drift over the drift of `stream`
    rows = [
        row | {"walk": row["name"].split(",")[0], "filter": filters[row["drift"]]}
        for row in load_result("bench_filter")["rows"]
        if row["drift"] in filters
    ]
    return tabulate_rows(
        "| motion | filter | edge distance, mm rms | its lag, ms "
        "| edge angle, deg rms | its lag, ms |",
        rows,
        "{walk}",
        *("{filter}", "{edge_mm_rms:.2f}", "{edge_mm_lag_ms:.0f}"),
        *("{edge_deg_rms:.1f}", "{edge_deg_lag_ms:.0f}"),
    )


def tabulate_explorer() -> str:
    """Tabulate how long pictures of `explore` take."""
    return tabulate_rows(
        "| stimulus | pictures | refused | ms, median | ms, 95 % | ms, most |",
        load_result("bench_explore")["rows"],
        "{name}",
        *("{pictures}", "{refused}", "{ms:.0f}", "{ms_p95:.0f}", "{most_ms:.0f}"),
    )


def tabulate_sizes() -> str:
    """Tabulate a simulated set's processor time and storage, per contact and multiplied."""
    lines = start_table("| step | measured, a contact | a million | 10^8, on paper |")
    for row in load_result("bench_data")["rows"]:
        if row["cpu_ms"] is not None:
            hours = row["cpu_ms"] / 3.6
            cells = [f"{row['cpu_ms']:.3g} ms", f"{hours:.2g} h", f"{100 * hours:.0f} h"]
            lines.append(format_line(f"{row['name']}: core", cells))
        if row["bytes"]:
            size = row["bytes"] / 1e3
            cells = [f"{size:.3g} kB", f"{size:.2g} GB", f"{size / 10:.2g} TB"]
            lines.append(format_line(f"{row['name']}: bytes", cells))
    return "\n".join(lines)


def tabulate_input() -> str:
    """Tabulate training steps with examples in memory, and with examples read as they go."""
    return tabulate_rows(
        "| networks over | batch | ms a step, examples there | read and drawn "
        "| ratio, median [its interval] | 95 % of turns |",
        load_result("bench_input")["rows"],
        "{name}",
        *("{batch}", "{ms_there:.1f}", "{ms_drawn:.1f}"),
        *("{ratio:.3f} [{ratio_low:.3f}, {ratio_high:.3f}]", "{ratio_p95:.2f}"),
    )


def tabulate_pin_networks() -> str:
    """Tabulate times of networks over pins, and how much longer plain layers take."""
    return tabulate_rows(
        "| E | what | batch | ms, median | ms, 95 % | plain layers, times as long |",
        load_result("bench_pinnets")["rows"],
        "{name}",
        *("{what}", "{batch}", "{ms:.2f}", "{ms_p95:.2f}", "{plain_over_fast:.2f}"),
    )


def tabulate_faults() -> str:
    """Tabulate the outcomes of the cases of each fault."""
    return tabulate_rows(
        "| fault | read or done by | cases | harmless | refused by name | lost | silent |",
        load_result("faults")["rows"],
        "{fault}",
        *("{command}", "{cases:,}", "{harmless:,}", "{refused:,}", "{lost:,}", "{silent:,}"),
    )


def tabulate_touch() -> str:
    """Tabulate how well contact, slip and shear of simulated contacts are measured."""
    return tabulate_rows(
        "| sensor, image | area under ROC | contacts refused | untouched refused "
        "| slip, rms (spread) | shear, mm rms (size) | deg rms (size) | interval holds, mm | deg |",
        [row for row in load_result("bench_touch")["rows"] if "auc" in row],
        "{name}",
        *("{auc:.4f}", "{refused:.1%}", "{refused_untouched:.1%}"),
        "{slip_rms:.2f} ({slip_sd:.2f})",
        "{shear_rms_mm:.3f} ({shear_sd_mm:.2f})",
        "{shear_rms_deg:.2f} ({shear_sd_deg:.2f})",
        *("{inside_mm:.1%}", "{inside_deg:.1%}"),
    )


def tabulate_recorded_touch() -> str:
    """Tabulate contact, slip and shear of recorded slides by their length."""
    return tabulate_rows(
        "| recorded slide | images | refused | least probability | slip | shear, mm | deg |",
        [row for row in load_result("bench_touch")["rows"] if "auc" not in row],
        "{name}",
        *("{images}", "{refused:.1%}", "{least_contact:.3f}", "{slip:.2f}", "{shear_mm:.2f}"),
        "{shear_deg:.2f}",
    )
