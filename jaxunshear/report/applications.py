"""Sections of a run's page for the results of commands that used its networks."""

from collections.abc import Callable
from pathlib import Path

from markupsafe import Markup, escape

from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object
from jaxunshear.report import html
from jaxunshear.report.html import format_number, format_with_interval
from jaxunshear.report.object_figure import PICTURES
from jaxunshear.report.trajectory_figure import METHOD_TITLES
from jaxunshear.results.folders import find_results_folder

KINDS = {"tap": "tap", "sheared": "sheared, as felt", "untouched": "untouched"} | {
    name: title for name, title in METHOD_TITLES.items() if "unsheared" in title
}
GEOMETRY_LEAD = (
    "How far the skin is pressed in, from the pins, against the simulator's own indentation: "
    "by the areas of their Voronoi cells, and by an inverse of the skin learnt from taps. "
    "Contacts that no network has seen, each with a 95 % interval over contacts, of one "
    "training. Images whose pins are not identified for sure are left out and counted."
)
TRAJECTORY_LEAD = (
    "The sensor follows outlines in the simulator, steered by what each way of perceiving "
    "reports. Walks that closed the outline; below, how far the sensor was from it in mm: mean "
    "/ 95th percentile / largest."
)
OBJECT_LEAD = (
    "The shape that each walk's images enclose, against the true one: area shared over area of "
    "either, mean of the walks; below, the outlines' mean and largest distance in mm. By "
    "height maps of the pins' cells (voronoi) or of where the skin stands."
)
STREAM_LEAD = "Frames from a source to unsheared image, pose and confidence, as on a robot."


def build_sections(run_dir: Path) -> list[Markup]:
    """Build the sections of commands that have been run. Raises UserError on damaged files."""
    sections = []
    for name, (title, lead, build_body) in SECTIONS.items():
        folder = find_results_folder(run_dir, name)
        file = folder / f"{name}.json"
        if not file.is_file():
            continue
        results = read_object(file)
        try:
            body = build_body(results, folder)
            sections.append(html.section(title, lead, *body, html.code(results["command"])))
        except (KeyError, TypeError, AttributeError) as error:
            remedy = f"run `jaxunshear {name}` again, or delete it"
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


SECTIONS = {  # by command: title, lead, and what shows its results
    "geometry": ("Contact geometry", GEOMETRY_LEAD, _show_geometry),
    "servo": ("Around objects by touch", TRAJECTORY_LEAD, _show_trajectories),
    "reconstruct": ("Complete objects", OBJECT_LEAD, _show_objects),
    "stream": ("As a stream", STREAM_LEAD, _show_stream),
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
