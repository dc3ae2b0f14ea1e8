"""The report of a run: one HTML page that a person understands at a glance, from the files that evaluation left.

Read `write_report` for the order of the page; each `_part` below it is one section.
"""

import json
from html import escape
from pathlib import Path
from typing import Any

from jaxunshear.errors import UserError
from jaxunshear.evaluation.measurements import measurements
from jaxunshear.evaluation.score import shown_kind
from jaxunshear.experiment import TRAINABLE
from jaxunshear.progress import duration
from jaxunshear.report import applications, figures, montage, page
from jaxunshear.report.history import History, read_history
from jaxunshear.report.page import number
from jaxunshear.storage import read_json, write_bytes, write_text

LABELS = {
    "tap": "tap (no slide)",
    "sheared": "sheared, as felt",
    "sheared_learnt": "sheared, PoseNet that learnt slides",
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
}

OVER_TIME = {  # a network's validation figures, drawn over its seconds of training
    "supervised": "unsheared image, MSE",
    "edge_mm": "edge distance of taps, mm",
    "edge_deg": "edge angle of taps, deg",
}


def write_report(run_dir: Path) -> Path:
    """Writes `report.html` and `montage.png` from `results.json`, `montage.npz`, `times.json` and the networks' `log.jsonl` in `run_dir`.

    Raises `UserError` where the run has not been evaluated or its files are damaged. Missing logs leave out their curves.
    """
    run_dir = Path(run_dir)
    results = read_json(run_dir / "results.json")
    times = run_dir / "times.json"
    if times.exists():  # it has grown since the evaluation
        results["time_s"] |= read_json(times)
    logs = {name: read_history(run_dir / name / "log.jsonl") for name in TRAINABLE}
    histories = {name: history for name, history in logs.items() if history}
    endings = {name: run_dir / name / "summary.json" for name in histories}
    summaries = {name: read_json(path) for name, path in endings.items() if path.exists()}
    shown = montage.read(run_dir / "montage.npz")
    try:
        parts = [
            _heading(results),
            _headlines(results),
            montage.section(shown),
            _similarity(results),
            _poses(results),
            _further(results),
            _pins(results),
            _swap(results),
            *applications.sections(run_dir),
            _training(histories, summaries),
            _times(results, histories),
            _contacts(results),
            _provenance(results),
        ]
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run_dir / 'results.json'} lacks {error}: run `jaxunshear evaluate` again") from error
    write_bytes(run_dir / "montage.png", montage.drawing(shown))
    path = run_dir / "report.html"
    write_text(path, page.page(f"jaxunshear: {results['experiment']}", *parts))
    return path


def _heading(results: dict[str, Any]) -> str:
    return (
        f"<h1>Taking the slide out of touch: {escape(results['experiment'])}</h1>\n<p>{escape(results['claim'])}</p>\n"
        "<p class=soft>A soft dome that slides over an edge feels its own shear on top of the shape. The networks of this run "
        "turn such an image into the one a plain tap would have given. Every figure of ours is measured on "
        "<b>simulated</b> contacts at poses kept out of training; the paper's, in "
        "<span class=real>tinted columns</span>, are from a <b>real</b> sensor.</p>"
    )


def _headlines(results: dict[str, Any]) -> str:
    rows = {row["name"]: row for row in measurements(results)["rows"]}
    similar, pose, pins = results["ms_ssim"], results["pose_mae"], results["pin_error"]
    name, kind = results["metric"]["ms_ssim"], shown_kind(similar)
    row, first = rows[f"ms_ssim.{kind}.overall"], rows["ms_ssim.sheared.overall"]
    note = f"at least {row['bar']:.2f} unsheared, at most {first['bar']:.2f} sheared" if row["bar"] else ""
    before, after = number(similar["sheared"]["overall"]), number(similar[kind]["overall"])
    met = row["ok"] and first["ok"] if row["bar"] else None
    shown = [page.card(f"Likeness to the tap ({name})", before, after, note, met)]
    for quantity, label, unit in (
        ("edge_mm", "Error in distance to the edge", "mm"),
        ("edge_deg", "Error in edge angle", "deg"),
    ):
        row = rows.get(f"pose_ratio.{kind}.{quantity}", {"bar": None, "ok": None})
        if kind not in pose:
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
            "Whole run", "", total, f"{results['machine']['cores']} cores, {results['machine']['device'].split(':')[0]}"
        ),
    )


def _similarity(results: dict[str, Any]) -> str:
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


def _poses(results: dict[str, Any]) -> str:
    ours, spread, paper = results["pose_mae"], results["spread"]["pose_mae"], results["paper"]["pose_mae"]
    if not ours:
        return page.section("What a pose network reads", "This run has no PoseNet.")
    known = list(paper["tap"])
    head = ["image given to PoseNet", *QUANTITY.values(), *(f"{QUANTITY[q]}<br>paper" for q in known)]
    rows = [
        [
            LABELS[kind],
            *(_with_interval(ours[kind][q], spread[kind][q], 2) for q in QUANTITY),
            *(number(paper.get(kind, {}).get(q)) for q in known),
        ]
        for kind in ours
    ]
    chance = results["baselines"]["pose_chance"]
    rows.append(["<i>one answer to every image</i>", *(number(chance[q]) for q in QUANTITY), *("" for _ in known)])
    kind = shown_kind(results["pose_recovery"])
    undone = ", ".join(
        f"{QUANTITY[q].replace('<br>', ' ').rpartition(' ')[0]} {recovery:.0%}{_span(results['spread']['pose_recovery'][kind][q])}"
        for q, recovery in results["pose_recovery"].get(kind, {}).items()
        if recovery is not None
    )
    lead = (
        "Mean absolute error of a PoseNet that has only learned from taps. x and yaw are ambiguous along a smooth edge; the "
        "distance to the edge and its local angle are not."
    )
    note = f"<p class=soft>Of what the slide spoils, the {kind} network wins back: {undone or 'nothing'}.</p>"
    return page.section(
        "What a pose network reads",
        lead,
        page.table(head, rows, range(1 + len(QUANTITY), len(head)), [len(ours) - 1]),
        note,
        _apart(results, "edge_mm", "mm from the edge", 3, -1),
    )


def _further(results: dict[str, Any]) -> str:
    """The tests of their own: shapes that no network has seen, taps at other depths."""
    parts = []
    for name, test in results["tests"].items():
        ours, pose, spread = test["ms_ssim"], test["pose_mae"], test["spread"]
        groups = list(next(iter(ours.values())))
        head = ["image", *groups, *(QUANTITY[q] for q in QUANTITY if pose)]
        rows = [
            [
                LABELS[kind],
                *(_with_interval(ours.get(kind, {}).get(g), spread["ms_ssim"].get(kind, {}).get(g), 3) for g in groups),
                *(_with_interval(pose[kind][q], spread["pose_mae"][kind][q], 2) for q in QUANTITY if kind in pose),
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


def _pins(results: dict[str, Any]) -> str:
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


def _swap(results: dict[str, Any]) -> str:
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


def _training(histories: dict[str, History], summaries: dict[str, dict]) -> str:
    if not histories:
        return page.section("Training", "This run has no training logs.")
    rows = [
        [
            name,
            f"{summary['parameters']:,}",
            str(summary["steps"]),
            f"{summary['images_per_second']:.3g}",
            duration(summary["train_seconds"]),
            str(summary["best_step"]),
        ]
        for name, summary in summaries.items()
    ]
    head = ["network", "parameters", "steps", "images/s", "training", "best at step"]
    text = "loss over epochs of " + ", ".join(histories)
    lead = "Losses at each validation, in training (thin) and on poses kept out of it (thick). The best step is used."
    return page.section("Training", lead, page.drawing(figures.loss_curves(histories), text), page.table(head, rows))


def _times(results: dict[str, Any], histories: dict[str, History]) -> str:
    stages = {name: value for name, value in results["time_s"].items() if value is not None}
    drawn = []
    if stages:
        text = "; ".join(f"{name} {value:.0f} s" for name, value in stages.items())
        drawn.append(page.drawing(figures.stage_times(list(stages), list(stages.values())), text))
    for name, label in OVER_TIME.items():
        if any(name in history.validation for history in histories.values()):
            drawn.append(
                page.drawing(figures.error_over_time(histories, name, label), f"{label} over seconds of training")
            )
    lead = "Wall clock of each stage of the run, and what the seconds of training bought on poses kept out of it."
    waits = "; ".join(
        f"{name} {times['median']:.1f} ms (95th percentile {times['p95']:.1f})"
        for name, times in results["ms_per_image"].items()
    )
    note = f"<p class=soft>One image at a time, compilation apart: {waits}.</p>"
    return page.section("Error against run time", lead, f"<div class=row>{''.join(drawn)}</div>", note)


def _contacts(results: dict[str, Any]) -> str:
    names = {
        "residual_mm": "solver residual, mm",
        "iterations": "solver iterations",
        "stuck": "nodes stuck",
        "slipping": "nodes slipping",
        "free": "nodes free",
    }
    head = ["sheared test contacts", "mean", "median", "95th percentile", "largest"]
    rows = [
        [names.get(field, escape(field)), *(f"{entry[q]:.3g}" for q in ("mean", "median", "p95", "max"))]
        for field, entry in results["contact"].items()
    ]
    counts = results["counts"]
    tried = ""
    if "contacts" in counts:
        tried = f"Of {counts['contacts']} contacts {counts['retried']} were solved again more finely and {counts['dropped']} dropped."
    pairs = (
        f"Pairs: {counts['train']} to train, {counts['validation']} to validate, {counts['test']} to test"
        if "train" in counts
        else ""
    )
    poses = f"{counts['test_poses']} test poses. {counts['pin_images']} images had their pins found."
    lead = "How well the simulated contacts behind the test images were solved."
    return page.section("Contact quality", lead, page.table(head, rows), f"<p class=soft>{tried} {pairs}; {poses}</p>")


def _provenance(results: dict[str, Any]) -> str:
    def lines(entries: dict[str, Any]) -> str:
        return page.table(("", ""), [[escape(str(k)), escape(str(v))] for k, v in entries.items()])

    settings = escape(json.dumps(results["settings"], indent=2))
    return page.section(
        "How to get this again",
        "The same command, seeds and versions on the same machine give the same numbers.",
        f"<pre>{escape(results['command'])}</pre>",
        f"<div class=row>{lines(results['seeds'])}{lines(results['machine'])}{lines(results['versions'])}</div>",
        f"<details><summary>All settings</summary><pre>{settings}</pre></details>",
    )


def _with_interval(value: float | None, interval: list[float] | None, digits: int) -> str:
    if value is None or interval is None:
        return number(None)
    return f"{number(value, digits)} <small>[{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]</small>"
