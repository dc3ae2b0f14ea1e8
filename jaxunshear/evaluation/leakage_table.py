"""Rows and a table of the results of `leakage`, for sweeps and for people."""

from collections.abc import Iterable

from jaxunshear.files import Json
from jaxunshear.text_table import format_text_table

DECODED_UNITS = {"rms_grey": "of 1 in grey", "rms_px": "px"}  # of images and pins
SLIDE_ERRORS = ("mae", "rmse", "coverage")


def build_sweep_rows(results: Json) -> list[Json]:
    """Build the rows of a sweep's ablation."""
    rows = [_select(row, DECODED_UNITS) for row in _list_exchange_rows(results)]
    for row in results["summary"]:
        if row["quantities"]:
            rows.append(_select(row, ("r2", "ceiling", "share", "largest share")))
    rows += [{"name": row["name"], "r2": row["r2"]} for row in results["rows"]]
    rows.append({"name": "standard scores", **results["scores"]})
    for row in results["slide"]:
        rows.append(_select(row, SLIDE_ERRORS) | {"name": f"{row['name']}, {row['part']}"})
    return rows


def _select(row: Json, names: Iterable[str]) -> Json:
    return {name: row[name] for name in ("name", *names) if name in row}


def format_table(results: Json) -> str:
    """Format the results for people."""
    rows = []
    for row in results["rows"]:
        figures = {name: row.get(name) for name in ("ceiling", "untrained", "shuffled")}
        head = {"R2 of": row["name"], "code [95 %]": _format_with_interval(row, "r2")}
        kind = "a leak" if row["leak"] else ""
        rows.append(head | {"strongest": row["family"], **figures, "kind": kind})
    lines = [format_text_table(rows, tuple(rows[0]))]
    for row in results["summary"]:
        if row["quantities"]:
            share, largest = row["share"], row["largest share"]
            lines.append(
                f"{row['name']}: {share:.0%} of the ceiling on average, {largest:.0%} at most"
            )
        if row["without a ceiling"]:
            hidden = ", ".join(row["without a ceiling"])
            lines.append(f"{row['name']}: the input does not show {hidden}: left out")
    for row in results["independence"]:
        lines.append(
            f"{row['name']}: HSIC {row['hsic']:.4f} of 1, p = {row['p']:.3f} of independence, "
            f"{row['planted p']:.3f} of a planted leak; {row['poses']} poses"
        )
    for name, value in results["scores"].items():
        lines.append(f"{name} by block: {value:.3f}")
    for row in _list_exchange_rows(results):
        name = next(name for name in DECODED_UNITS if name in row)
        error = _format_with_interval(row | {f"{name} interval": row["interval"]}, name)
        lines.append(
            f"{row['name']}: {error} {DECODED_UNITS[name]} "
            "from the contact of that pose and that slide"
        )
    for row in results["slide"]:
        mae, coverage = _format_with_interval(row, "mae"), _format_with_interval(row, "coverage")
        lines.append(
            f"{row['name']} from both codes, {row['part']} ({row['slides']}): error {mae}; "
            f"95 % intervals hold {coverage}"
        )
    return "\n".join([*lines, results["metric"]])


def _format_with_interval(row: Json, name: str) -> str:
    return "{:.3g} [{:.3g}, {:.3g}]".format(row[name], *row[f"{name} interval"])


def _list_exchange_rows(results: Json) -> list[Json]:
    """List errors of exchanged codes, overall and by slip."""
    errors = results["exchanged"]
    if not errors:
        return []
    rows = []
    for part in (errors, *errors["by slip"]):
        end = f", {part['part']}" if "part" in part else ""
        for name, row in part["drawn"].items():
            rows.append({"name": f"DS, codes {name}{end}", **row})
    return rows
