"""Sections of a run's page for the results of commands that used its networks."""

from collections.abc import Callable
from pathlib import Path

from markupsafe import Markup, escape

from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object
from jaxunshear.report import html
from jaxunshear.report.application_figures import METHOD_TITLES, PICTURES
from jaxunshear.report.html import (
    format_cells,
    format_number,
    format_paper_headings,
    format_with_interval,
)
from jaxunshear.report.wording import section
from jaxunshear.results.record_files import find_results_folder

KINDS = {"tap": "tap", "sheared": "sheared", "untouched": "untouched"} | {
    name: title for name, title in METHOD_TITLES.items() if "unsheared" in title
}


def build_sections(run_dir: Path) -> dict[str, Markup]:
    """Build the sections of commands that have been run, by their file.

    Raises UserError on damaged files.
    """
    sections = {}
    for name, build_body in BODIES.items():
        folder = find_results_folder(run_dir, name)
        file = folder / f"{name}.json"
        if not file.is_file():
            continue
        results = read_object(file)
        try:
            body = [*build_body(results, folder), html.code(results["command"])]
            sections[name] = section(name, *body)
        except (KeyError, TypeError, AttributeError) as error:
            remedy = "run its command again, or delete it"
            raise UserError(f"{file} lacks {error}: {remedy}") from error
    return sections


def _show_geometry(results: Json, folder: Path) -> list[Markup]:
    rows = [
        [
            KINDS.get(row["kind"], row["kind"]),
            row["way"],
            _format_score(row, "correlation"),
            _format_score(row, "rmse_mm"),
            f"{row['unmatched']} of {row['contacts']}",
            format_number(row["ms_per_image"], 1),
        ]
        for row in results["rows"]
        if row["stimulus"] == "all"
    ]
    head = ["image", "by", "correlation", "error, mm rms", "pins not sure", "ms an image"]
    return [html.table(head, rows), _embed_png(folder / "geometry.png")]


def _format_score(row: Json, name: str) -> str:
    return format_with_interval(row.get(name), row.get(f"{name}_interval"), 3)


def _show_trajectories(results: Json, folder: Path) -> list[Markup]:
    rows = results["rows"]
    times = {row["way"]: row["perceive_ms"] for row in rows if row["way"] != "true"}
    listed = "; ".join(f"{METHOD_TITLES.get(name, name)} {ms:.1f} ms" for name, ms in times.items())
    return [
        _build_method_table(rows, _format_trajectory),
        html.soft(f"Perceiving takes, a step: {listed}."),
        *(_embed_png(folder / f"{name}.png") for name in _list_values(rows, "stimulus")),
    ]


def _format_trajectory(row: Json) -> str:
    distances = (format_number(row[name]) for name in ("mean_mm", "p95_mm", "largest_mm"))
    form = Markup("{} of {}<small>{} / {} / {}</small>")
    return form.format(row["closed"], row["starts"], *distances)


def _show_objects(results: Json, folder: Path) -> list[Markup]:
    pictures = []
    for name in _list_values(results["rows"], "stimulus"):
        pictures += [_embed_png(folder / f"{name}-{file}.png") for file, _ in PICTURES.values()]
    rows = [row | {"stimulus": f"{row['stimulus']}, {row['object']}"} for row in results["rows"]]
    return [_build_method_table(rows, _format_object), *pictures]


def _format_object(row: Json) -> str:
    distances = format_number(row["mean_mm"]), format_number(row["hausdorff_mm"], 1)
    return Markup("{}<small>{} / {}</small>").format(format_number(row["iou"], 3), *distances)


def _show_stream(results: Json, folder: Path) -> list[Markup]:
    latency = results["latency_ms"] or {}
    rows = [[name, str(results[name])] for name in ("used", "skipped", "dropped")]
    rows += [[f"{name}, ms", format_number(value, 1)] for name, value in latency.items()]
    return [html.table(("frames", ""), rows)]


def _show_ablation(results: Json, folder: Path) -> list[Markup]:
    digits = {"mse": 3, "ssim": 3, "ms_ssim": 3}
    rows = []
    for row in results["rows"]:
        spans = {name: row.get(f"{name} interval") for name in digits}
        paper = [format_number((row["paper"] or {}).get(name), 3) for name in ("mse", "ms_ssim")]
        rows.append([row["name"], row["target"], *format_cells(row, spans, digits), *paper])
    metrics = ["MSE", "SSIM", results["metric"]["ms_ssim"]]
    head = ["decoder(codes)", "should draw", *metrics, *format_paper_headings(("MSE", "MS-SSIM"))]
    return [html.table(head, rows, (5, 6)), _embed_png(folder / "leakage.png")]


BODIES = {
    "geometry": _show_geometry,
    "servo": _show_trajectories,
    "reconstruct": _show_objects,
    "ablation": _show_ablation,
    "stream": _show_stream,
}


def _build_method_table(rows: list[Json], format_cell: Callable[[Json], str]) -> Markup:
    """Build a table with a row per object and a column per method of perceiving."""
    cells = {(row["stimulus"], row["way"]): format_cell(row) for row in rows}
    methods, lines = _list_values(rows, "way"), []
    for name in _list_values(rows, "stimulus"):
        lines.append([name, *(cells.get((name, method), "") for method in methods)])
    titles = (escape(METHOD_TITLES.get(method, method)) for method in methods)
    return html.table(
        ["object", *(title.replace(", ", Markup(",<br>")) for title in titles)], lines
    )


def _list_values(rows: list[Json], field: str) -> list[str]:
    return list(dict.fromkeys(row[field] for row in rows))


def _embed_png(file: Path) -> Markup:
    if not file.is_file():
        return Markup()
    return html.figure(html.make_png_address(file.read_bytes()), file.stem)
