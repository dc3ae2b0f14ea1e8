"""Sections of a run's report: what was measured, image by image and pose by pose, with the paper's figures beside."""

from html import escape
from typing import Any

from jaxunshear.evaluation.measurements import measurements
from jaxunshear.evaluation.score import shown_kind
from jaxunshear.progress import duration
from jaxunshear.report import page
from jaxunshear.report.page import number

LABELS = {
    "tap": "tap (no slide)",
    "sheared": "sheared, as felt",
    "sheared_learnt": "sheared, PoseNet that learnt slides",
    "code_learnt": "sheared, head on the pose code",
    "both_learnt": "mean of the head's and the unsheared image's",
    "mean_tap": "mean of the training taps",
    "nearest_tap": "training tap nearest to the sheared",
    "translated": "sheared, best translation (knows the tap)",
    "entangled": "unsheared, entangled",
    "entangled_large": "unsheared, entangled, as many parameters",
    "unet": "unsheared, U-Net",
    "disentangled": "unsheared, disentangled",
    "true_slide": "sheared, pins known by name",
}
QUANTITY = {
    "x_mm": "x<br>mm",
    "yaw_deg": "yaw<br>deg",
    "edge_mm": "edge distance<br>mm",
    "edge_deg": "edge angle<br>deg",
}  # others are shown by their own names


def headlines(results: dict[str, Any]) -> str:
    rows = {row["name"]: row for row in measurements(results)["rows"]}
    similar, pose, pins = results["ms_ssim"], results["pose_mae"], results["pin_error"]
    name, kind = results["metric"]["ms_ssim"], shown_kind(similar)
    row, first = rows[f"ms_ssim.{kind}.overall"], rows["ms_ssim.sheared.overall"]
    held = row["bar"] and kind != "sheared"  # a run without a network that unshears has nothing to hold against a bar
    note = f"at least {row['bar']:.2f} unsheared, at most {first['bar']:.2f} sheared" if held else ""
    before, after = number(similar["sheared"]["overall"]), number(similar[kind]["overall"])
    met = row["ok"] and first["ok"] if held else None
    shown = [page.card(f"Likeness to the tap ({name})", before, after, note, met)]
    for quantity, label, unit in (
        ("edge_mm", "Error in distance to the edge", "mm"),
        ("edge_deg", "Error in edge angle", "deg"),
    ):
        row = rows.get(f"pose_ratio.{kind}.{quantity}", {"bar": None, "ok": None})
        if quantity not in pose.get(kind, {}):
            continue
        digits = 2 if unit == "mm" else 1
        before, after = (number(pose[image][quantity], digits) for image in ("sheared", kind))
        note = f"at most {row['bar']:g} of the sheared error" if row["bar"] else ""
        shown.append(page.card(label, before, f"{after} {unit}", note, row["ok"]))
    total = duration(sum(results["time_s"].values()))
    return page.cards(
        *shown,
        page.card(
            "Pins away from the tap's",
            number(pins["true_slide"]["rms_px"], 1),
            f"{number(pins[kind]['rms_px'], 2)} px",
            f"of {results['metric']['image_px']} px; root mean square",
        ),
        page.card(
            "Whole run",
            "",
            total,
            f"sum of its stages; {results['machine']['cores']} cores, {results['machine']['device'].split(':')[0]}",
        ),
    )


def similarity(results: dict[str, Any]) -> str:
    ours, spread, paper = results["ms_ssim"], results["spread"]["ms_ssim"], results["paper"]["ms_ssim"]
    groups = list(next(iter(ours.values())))
    known = [group for group in groups if group in paper["sheared"]]
    head = ["image compared with its tap", *groups, *(f"{group}<br>paper" for group in known)]
    rows = [
        [
            LABELS[kind],
            *(_with_interval(ours[kind][group], spread[kind][group], 3) for group in groups),
            *(number(paper.get(kind, {}).get(group)) for group in known),
        ]
        for kind in ours
    ]
    name, size = results["metric"]["ms_ssim"], results["metric"]["image_px"]
    lead = f"{name} at {size} px, 1 is equal. Brackets: {results['spread']['what']}."
    if name != "ms_ssim":
        lead += " The paper's has five scales at 256 px: near, but not the same quantity."
    real = range(1 + len(groups), len(head))
    return page.section(
        "How alike the images are",
        lead,
        page.table(head, rows, real, [len(rows) - 1]),
        _apart(results, "ms_ssim", "likeness", 4, 1),
    )


def _apart(results: dict[str, Any], column: str, what: str, digits: int, better: int) -> str:
    """The disentangled network less each other one, contact by contact; `better` is the sign of a gain."""
    said = []
    for kind, columns in results["difference"].items():
        if column not in columns:
            continue
        low, high = results["spread"]["difference"][kind][column]
        verdict = "not told apart" if low <= 0 <= high else "better" if low * better > 0 else "worse"
        name = LABELS[kind].removeprefix("unsheared, ").removeprefix("sheared, ")
        said.append(f"{name} {columns[column]:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}] ({verdict})")
    return (
        f"<p class=soft>Contact by contact, disentangled less other networks, {what}: {'; '.join(said)}.</p>"
        if said
        else ""
    )


def poses(results: dict[str, Any]) -> str:
    ours, spread, paper = results["pose_mae"], results["spread"]["pose_mae"], results["paper"]["pose_mae"]
    if not ours:
        return page.section("What a pose network reads", "This run has no PoseNet.")
    quantities = _quantities(ours)
    known = [q for q in paper["tap"] if q in quantities]
    head = ["image given to PoseNet", *map(_label, quantities), *(f"{_label(q)}<br>paper" for q in known)]
    rows = [
        [
            LABELS[kind],
            *(_with_interval(ours[kind].get(q), spread[kind].get(q), 2) for q in quantities),
            *(number(paper.get(kind, {}).get(q)) for q in known),
        ]
        for kind in ours
    ]
    chance = results["baselines"]["pose_chance"]
    rows.append(
        ["<i>one answer to every image</i>", *(number(chance.get(q)) for q in quantities), *("" for _ in known)]
    )
    kind = shown_kind(results["pose_recovery"])
    undone = ", ".join(
        f"{_label(q).partition('<br>')[0]} {recovery:.0%}{_span(results['spread']['pose_recovery'][kind][q])}"
        for q, recovery in results["pose_recovery"].get(kind, {}).items()
        if recovery is not None
    )
    lead = (
        "Mean absolute error of a PoseNet that has only learned from taps. x and yaw are ambiguous along a smooth edge; the "
        "distance to the edge and its local angle are not."
    )
    note = (
        f"<p class=soft>Of what the slide spoils, the {kind} network wins back: {undone or 'nothing'}.</p>"
        if kind != "sheared"
        else ""
    )
    return page.section(
        "What a pose network reads",
        lead,
        page.table(head, rows, range(1 + len(quantities), len(head)), [len(ours) - 1]),
        note,
        _won_back(results, "pose_by_stimulus", "shape"),
        _won_back(results, "pose_by_depth", "depth"),
        _apart(results, "edge_mm", "mm from the edge", 3, -1),
    )


def _quantities(errors: dict[str, dict[str, float]]) -> list[str]:
    """All that any kind of image is read for: those of QUANTITY in its order, then others in theirs."""
    read = dict.fromkeys(name for kind in errors.values() for name in kind)
    return sorted(read, key=lambda name: [*QUANTITY, name].index(name))


def _label(quantity: str) -> str:
    name, _, unit = quantity.rpartition("_")
    return QUANTITY.get(quantity, f"{name}<br>{unit}")


def _won_back(results: dict[str, Any], table: str, by: str) -> str:
    """What is won back in each part of `table`, by the network that `poses` names; folded away. Nothing of runs evaluated by an
    earlier version."""
    kind = shown_kind(results["pose_recovery"])
    rows, quantities = [], _quantities(results["pose_mae"])
    for part, found in results.get(table, {}).items():
        if found and kind in found["pose_recovery"]:
            won, spread = found["pose_recovery"][kind], found["spread"]["pose_recovery"][kind]
            rows.append([escape(part), *(_with_interval(won.get(q), spread.get(q), 2) for q in quantities)])
    if not rows:
        return ""
    head = [f"won back, by {by}", *(_label(q).partition("<br>")[0] for q in quantities)]
    return f"<details><summary>By {by}</summary>{page.table(head, rows)}</details>"


def further(results: dict[str, Any]) -> str:
    """The tests of their own: shapes that no network has seen, taps at other depths."""
    parts = []
    for name, test in results["tests"].items():
        ours, pose, spread = test["ms_ssim"], test["pose_mae"], test["spread"]
        groups, quantities = list(next(iter(ours.values()))), _quantities(pose)
        head = ["image", *groups, *map(_label, quantities)]
        rows = [
            [
                LABELS[kind],
                *(_with_interval(ours.get(kind, {}).get(g), spread["ms_ssim"].get(kind, {}).get(g), 3) for g in groups),
                *(
                    _with_interval(pose[kind].get(q), spread["pose_mae"][kind].get(q), 2)
                    for q in quantities
                    if kind in pose
                ),
            ]
            for kind in LABELS
            if kind in pose or kind in ours
        ]
        what = "shapes that no network has seen" if name == "unseen" else "the shapes trained on"
        jitter = test["tap_depth_jitter_mm"]
        depth = (
            f"taps as deep as the slide, but for up to {jitter:g} mm either way"
            if jitter
            else "taps as deep as the slide"
        )
        lead = f"{test['contacts']} slides over {what}, {depth}: likeness of the images, then errors of pose."
        parts.append(
            page.section(f"Test of its own: {escape(name)}", lead, page.table(head, rows, (), [len(rows) - 1]))
        )
    return "".join(parts)


def _span(interval: list[float] | None) -> str:
    return "" if interval is None else f" [{interval[0]:.0%}, {interval[1]:.0%}]"


def pins(results: dict[str, Any]) -> str:
    rows = [
        [
            LABELS[kind],
            number(error["rms_px"]),
            number(error["rms_mm"], 3),
            number(error.get("missed_per_image"), 1),
            number(error.get("extra_per_image"), 1),
        ]
        for kind, error in results["pin_error"].items()
    ]
    lead = (
        "Centroids found in each image, matched one to one with the tap's true pins within half a pitch. The first row is what "
        "finding pins costs by itself; the last is how far the slide really moved them."
    )
    order = dict(zip(results["pin_error"], rows, strict=True))
    head = ["image", "error, px rms", "error, mm rms", "missed per image", "extra per image"]
    return page.section("Where the pins are", lead, page.table(head, [order[kind] for kind in LABELS if kind in order]))


def swap(results: dict[str, Any]) -> str:
    paper, name = results["paper"]["swap"], results["metric"]["ms_ssim"]
    rows = [
        [
            escape(cell),
            entry["target"],
            *(number(entry[m], 3) for m in ("mse", "ssim", "ms_ssim")),
            number(paper[cell]["mse"], 3),
            number(paper[cell]["ms_ssim"], 3),
        ]
        for cell, entry in results["swap"].items()
    ]
    lead = (
        "Each decoder fed the code it was trained on, and the wrong one (z_p: pose code, z_s: shear code). A bad image from the "
        "wrong code shows that the decoder uses its code, not that the code is free of the other factor."
    )
    head = ["decoder(codes)", "should draw", "MSE", "SSIM", name, "MSE<br>paper", "SSIM<br>paper"]
    return page.section("Swapped codes", lead, page.table(head, rows, (5, 6)))


def _with_interval(value: float | None, interval: list[float] | None, digits: int) -> str:
    if value is None or interval is None:
        return number(value, digits)
    return f"{number(value, digits)} <small>[{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]</small>"
