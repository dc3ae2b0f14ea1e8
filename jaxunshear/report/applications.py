"""What the networks were put to: sections of a run's page, for those of the commands whose results lie in the run's folder."""

from collections.abc import Callable
from pathlib import Path

from markupsafe import Markup, escape

from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object
from jaxunshear.report import html
from jaxunshear.report.html import address_of, format_number, format_with_interval
from jaxunshear.report.object_figure import PICTURES
from jaxunshear.report.trajectory_figure import METHOD_TITLES
from jaxunshear.results.folders import find_results_folder

KINDS = {"tap": "tap", "sheared": "sheared, as felt", "untouched": "untouched"} | {
    name: METHOD_TITLES[name] for name in METHOD_TITLES if "unsheared" in METHOD_TITLES[name]
}


def build_sections(run_dir: Path) -> list[Markup]:
    """HTML, in the order geometry, walks, objects, stream; nothing for a command that has not been run. Raises `UserError`."""
    found = []
    for name, part in (
        ("geometry", _geometry),
        ("servo", _walks),
        ("reconstruct", _objects),
        ("stream", _stream),
    ):
        folder = find_results_folder(run_dir, name)
        file = folder / f"{name}.json"
        if not file.is_file():
            continue
        try:
            found.append(part(read_object(file), folder))
        except (KeyError, TypeError, AttributeError) as error:
            raise UserError(
                f"{file} lacks {error}: run `jaxunshear {name}` again, or delete it"
            ) from error
    return found


def _geometry(results: Json, folder: Path) -> Markup:
    rows = [
        [
            KINDS.get(row["kind"], row["kind"]),
            row["way"],
            _format_with_interval(row, "correlation"),
            _format_with_interval(row, "rmse_mm"),
            f"{row['unmatched']} of {row['contacts']}",
            format_number(row["ms_per_image"], 1),
        ]
        for row in results["rows"]
        if row["stimulus"] == "all"
    ]
    head = ["image", "by", "correlation", "error, mm rms", "pins not sure", "ms an image"]
    lead = (
        "How far the skin is pressed in, from the pins, against the simulator's own indentation: by the areas of their Voronoi cells, "
        "and by an inverse of the skin learnt from taps. Contacts that no network has seen, "
        "each with a 95 % interval over contacts, of one training. Images whose pins are not identified for sure are left out and counted."
    )
    return html.section(
        "Contact geometry",
        lead,
        html.table(head, rows),
        _picture(folder / "geometry.png"),
        _command(results),
    )


def _walks(results: Json, folder: Path) -> Markup:
    def cell(row: Json) -> str:
        distances = (format_number(row[name]) for name in ("mean_mm", "p95_mm", "largest_mm"))
        return Markup("{} of {}<small>{} / {} / {}</small>").format(
            row["closed"], row["starts"], *distances
        )

    lead = (
        "The sensor follows outlines in the simulator, steered by what each way of perceiving reports. Walks that closed the outline; "
        "below, how far the sensor was from it in mm: mean / 95th percentile / largest."
    )
    ways = {row["way"]: row["perceive_ms"] for row in results["rows"]}
    times = "; ".join(
        f"{METHOD_TITLES.get(way, way)} {ms:.1f} ms" for way, ms in ways.items() if way != "true"
    )
    names = list(dict.fromkeys(row["stimulus"] for row in results["rows"]))
    return html.section(
        "Around objects by touch",
        lead,
        _build_method_table(results["rows"], cell),
        html.soft(f"Perceiving takes, a step: {times}."),
        *(_picture(folder / f"{name}.png") for name in names),
        _command(results),
    )


def _objects(results: Json, folder: Path) -> Markup:
    def cell(row: Json) -> str:
        distances = format_number(row["mean_mm"]), format_number(row["hausdorff_mm"], 1)
        return Markup("{}<small>{} / {}</small>").format(format_number(row["iou"], 3), *distances)

    lead = (
        "The shape that each walk's images enclose, against the true one: area shared over area of either, mean of the walks; below, "
        "the outlines' mean and largest distance in mm. By height maps of the pins' cells (voronoi) or of where the skin stands."
    )
    names = list(dict.fromkeys(row["stimulus"] for row in results["rows"]))
    pictures = (
        _picture(folder / f"{name}-{file}.png") for name in names for file, _ in PICTURES.values()
    )
    lines = [row | {"stimulus": f"{row['stimulus']}, {row['object']}"} for row in results["rows"]]
    return html.section(
        "Complete objects", lead, _build_method_table(lines, cell), *pictures, _command(results)
    )


def _stream(results: Json, folder: Path) -> Markup:
    latency = results["latency_ms"] or {}
    rows = [[name, str(results[name])] for name in ("used", "skipped", "dropped")]
    rows += [[f"{name}, ms", format_number(value, 1)] for name, value in latency.items()]
    lead = "Frames from a source to unsheared image, pose and confidence, as on a robot."
    return html.section("As a stream", lead, html.table(("frames", ""), rows), _command(results))


def _build_method_table(rows: list[Json], cell: Callable[[Json], str]) -> Markup:
    """A line an object, a column a way of perceiving."""
    ways = list(dict.fromkeys(row["way"] for row in rows))
    found = {(row["stimulus"], row["way"]): cell(row) for row in rows}
    names = list(dict.fromkeys(row["stimulus"] for row in rows))
    lines = [[name, *(found.get((name, way), "") for way in ways)] for name in names]
    return html.table(
        [
            "object",
            *(escape(METHOD_TITLES.get(way, way)).replace(", ", Markup(",<br>")) for way in ways),
        ],
        lines,
    )


def _format_with_interval(row: Json, name: str) -> str:
    if name not in row:
        return format_number(None)
    return format_with_interval(row[name], row[f"{name}_interval"], 3)


def _picture(file: Path) -> Markup:
    return html.figure(address_of(file.read_bytes()), file.stem) if file.is_file() else Markup()


def _command(results: Json) -> Markup:
    return html.code(results["command"])
