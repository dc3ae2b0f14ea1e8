"""What `leakage` found, for sweeps and for people."""

from jaxunshear.files import Json

UNITS = {"rms_grey": "of 1 in grey", "rms_px": "px"}  # of what DS draws, over images and over pins
DECODED_UNITS = (*UNITS, "missed_per_image")
SLIDE = ("mae", "rmse", "coverage")


def build_sweep_rows(results: Json) -> list[Json]:
    """Rows of a sweep's ablation."""
    rows = []
    for part, errors in _list_exchanged(results):
        for name, row in errors["drawn"].items():
            rows.append(
                {"name": f"DS, codes {name}{part}"} | {n: row[n] for n in DECODED_UNITS if n in row}
            )
    for row in results["summary"]:
        if row["quantities"]:
            rows.append({n: row[n] for n in ("name", "r2", "ceiling", "share", "largest share")})
    rows += [{"name": row["name"], "r2": row["r2"]} for row in results["rows"]]
    rows.append({"name": "standard scores", **results["scores"]})
    rows += [
        {"name": f"{row['name']}, {row['part']}"} | {n: row[n] for n in SLIDE}
        for row in results["slide"]
    ]
    return rows


def format_table(results: Json) -> str:
    """For people."""
    lines = [f"{'R2 of':24}  code [95 %]              strongest      ceiling  untrained  shuffled"]
    for row in results["rows"]:
        low, high = row["r2 interval"]
        values = [row.get(name) for name in ("ceiling", "untrained", "shuffled")]
        more = "  ".join("    none" if value is None else f"{value:8.3f}" for value in values)
        mark = "  a leak" if row["leak"] else ""
        lines.append(
            f"{row['name']:24}  {row['r2']:6.3f} [{low:.3f}, {high:.3f}]   {row['family']:12}  {more}{mark}"
        )
    for row in results["summary"]:
        if row["quantities"]:
            share, largest = row["share"], row["largest share"]
            lines.append(
                f"{row['name']}: {share:.0%} of the ceiling on average, {largest:.0%} at most"
            )
        if row["without a ceiling"]:
            lines.append(
                f"{row['name']}: the input does not show {', '.join(row['without a ceiling'])}: left out"
            )
    for row in results["independence"]:
        lines.append(
            f"{row['name']}: HSIC {row['hsic']:.4f} of 1, p = {row['p']:.3f} of independence, "
            f"{row['planted p']:.3f} of a planted leak; {row['poses']} poses"
        )
    for name, value in results["scores"].items():
        lines.append(f"{name} by block: {value:.3f}")
    for part, errors in _list_exchanged(results):
        for name, row in errors["drawn"].items():
            low, high = row["interval"]
            value, unit = next((row[name], unit) for name, unit in UNITS.items() if name in row)
            text = f"{value:.3f} [{low:.3f}, {high:.3f}] {unit} from the contact of that pose and that slide"
            lines.append(f"DS, codes {name}{part}: {text}")
    for row in results["slide"]:
        mae, coverage = (
            "{:.3g} [{:.3g}, {:.3g}]".format(row[name], *row[f"{name} interval"])
            for name in ("mae", "coverage")
        )
        lines.append(
            f"{row['name']} from both codes, {row['part']} ({row['slides']}): error {mae}; 95 % intervals hold {coverage}"
        )
    return "\n".join([*lines, results["metric"]])


def _list_exchanged(results: Json) -> list[tuple[str, Json]]:
    """What DS draws of exchanged codes, all of it and its parts, each with what its name ends in."""
    errors = results["exchanged"]
    return (
        [("", errors), *((f", {part['part']}", part) for part in errors["by slip"])]
        if errors
        else []
    )
