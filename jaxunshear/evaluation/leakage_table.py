"""Rows and a table of the results of `leakage`, for sweeps and for people."""

from jaxunshear.files import Json

UNITS = {"rms_grey": "of 1 in grey", "rms_px": "px"}  # of reconstructions: images and pins
DECODED_UNITS = (*UNITS, "missed_per_image")
SLIDE_ERRORS = ("mae", "rmse", "coverage")


def build_sweep_rows(results: Json) -> list[Json]:
    """Build the rows of a sweep's ablation."""
    rows = []
    for part, errors in _list_exchange_parts(results):
        for name, row in errors["drawn"].items():
            rows.append({"name": f"DS, codes {name}{part}"} | _select(row, DECODED_UNITS))
    for row in results["summary"]:
        if row["quantities"]:
            rows.append(_select(row, ("name", "r2", "ceiling", "share", "largest share")))
    rows += [{"name": row["name"], "r2": row["r2"]} for row in results["rows"]]
    rows.append({"name": "standard scores", **results["scores"]})
    for row in results["slide"]:
        rows.append({"name": f"{row['name']}, {row['part']}"} | _select(row, SLIDE_ERRORS))
    return rows


def _select(row: Json, names: tuple[str, ...]) -> Json:
    return {name: row[name] for name in names if name in row}


def format_table(results: Json) -> str:
    """Format the results for people."""
    lines = [f"{'R2 of':24}  code [95 %]              strongest      ceiling  untrained  shuffled"]
    lines += [_format_row(row) for row in results["rows"]]
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
    for part, errors in _list_exchange_parts(results):
        for name, row in errors["drawn"].items():
            lines.append(f"DS, codes {name}{part}: {_format_exchange_error(row)}")
    for row in results["slide"]:
        mae, coverage = _format_with_interval(row, "mae"), _format_with_interval(row, "coverage")
        lines.append(
            f"{row['name']} from both codes, {row['part']} ({row['slides']}): error {mae}; "
            f"95 % intervals hold {coverage}"
        )
    return "\n".join([*lines, results["metric"]])


def _format_row(row: Json) -> str:
    low, high = row["r2 interval"]
    values = [row.get(name) for name in ("ceiling", "untrained", "shuffled")]
    more = "  ".join("    none" if value is None else f"{value:8.3f}" for value in values)
    mark = "  a leak" if row["leak"] else ""
    return (
        f"{row['name']:24}  {row['r2']:6.3f} [{low:.3f}, {high:.3f}]   {row['family']:12}  "
        f"{more}{mark}"
    )


def _format_exchange_error(row: Json) -> str:
    low, high = row["interval"]
    name = next(name for name in UNITS if name in row)
    return (
        f"{row[name]:.3f} [{low:.3f}, {high:.3f}] {UNITS[name]} "
        "from the contact of that pose and that slide"
    )


def _format_with_interval(row: Json, name: str) -> str:
    return "{:.3g} [{:.3g}, {:.3g}]".format(row[name], *row[f"{name} interval"])


def _list_exchange_parts(results: Json) -> list[tuple[str, Json]]:
    """List errors of exchanged codes, overall and by slip, each with the end of its name."""
    errors = results["exchanged"]
    if not errors:
        return []
    return [("", errors), *((f", {part['part']}", part) for part in errors["by slip"])]
