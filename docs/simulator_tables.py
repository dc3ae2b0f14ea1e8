"""Tables of the simulator and of speed: what was fitted, verified and timed."""

import re
from statistics import fmean

from docs.reading import as_line, by_name, take

FITS = {
    "calibrate_edge_2d": "edge, taps and slides",
    "calibrate_surface_2d_331": "flat surface",
    "calibrate_surface_3d_sample": "flat surface, another arm",
}
FITTED = {"friction": 2, "skin_to_gel": 0, "pin_spacing_mm": 2}
STATISTICS = {  # of images: the rows of each line, digits
    "pins found": (("pins found",), 1),
    "pin spacing, px of 128": (("pin spacing",), 2),
    "pin diameter, px of 128": (("pin diameter",), 2),
    "white share of pins, of the full image": (("white share of pins", "white share of image"), 3),
    "rings 1, 5, 9 over the outermost": (tuple(f"ring {k} over outermost" for k in (1, 5, 9)), 3),
}
SLIDES = {  # pins left behind: the rows that each column takes together
    "0 to 1": ("0 to 1",),
    "1 to 2": ("1 to 2",),
    "2 to 3": ("2 to 3",),
    "above 3 mm": ("3 to 4", "4 to 5", "5 or more"),
}
LEFT_BEHIND = {
    "central pins left behind": f"central pins left behind by a slide of {', '.join(SLIDES)}",
    "outermost ring left behind": "outermost ring left behind, the same",
}
PROBLEMS = {  # what a line shows: the group, and the beginnings of the problems, each with its largest error
    "Hertz: force, radius, peak pressure": ("Hertz", ("force", "contact radius", "peak pressure")),
    "Cattaneo and Mindlin: pull, stick radius": ("Cattaneo-Mindlin", ("pull", "stick radius")),
    "flat punch: force, pull, moment": ("flat punch", ("force", "stuck pull", "stuck moment")),
    "torsion: stuck, slipping": ("torsion", ("stuck", "slipping")),
    "loss of a cycle: the pull's work, heat": (
        "Mindlin-Deresiewicz",
        (r"loss of a cycle .* the pull's work", r"loss of a cycle .* heat"),
    ),
    "normal contact against tamaas: depth, extent": (
        "normal contact against tamaas",
        (".*: depth", ".*: extent"),
    ),
    "the same: share of the force at another place": (
        "normal contact against tamaas",
        (".*: share",),
    ),
    "oblique press without slip (Mindlin and Deresiewicz)": ("Mindlin-Deresiewicz", ("oblique",)),
    "edge passed in steps of 0.05 mm, by taps, by slides: a step against the one before": (
        "the dome",
        ("edge passed by taps", "edge passed by slides"),
    ),
}
LARGE = re.compile(
    r"(\d) mm deep.* their ([\d.]+) px.* p95 ([\d.]+).*force x ([\d.]+), radius x ([\d.]+).*beyond 20 % in (\d+) %"
)
LEVELS = {
    "fast, batch 64": "`fast`",
    "auto, batch 64": "`auto`",
    "auto, float64": "`auto`, float64",
    "auto, steps times 2": "`auto`, steps halved",
    "auto, nothing left out, batch 64": "`auto`, nothing left out",
    "reference, batch 64": "`reference`",
}
COMPILED, XLA = "jaxunshear", "jaxunshear, XLA alone"
TRAINED_ON = {"bench_train": "AMD EPYC", "bench_train_xeon": "Intel Xeon"}
TORCH = ("pytorch", "pytorch, compiled")


def fits() -> str:
    """What was fitted to recordings, with its interval."""
    lines = [
        "| recordings | contacts | friction | skin : gel | pins apart, mm | rings apart before / after, px of 128 |",
        "|---|---|---|---|---|---|",
    ]
    for name, shown in FITS.items():
        held = take(name)
        fitted = {each["name"]: each for each in held["parameters"]}
        cells = [
            f"{one['after']:.{digits}f} [{one['low']:.{digits}f}, {one['high']:.{digits}f}]"
            if (one := fitted[parameter])["determined"]
            else "not determined"
            for parameter, digits in FITTED.items()
        ]
        rings = held["ring_error_px"]
        apart = f"{rings['before']:.1f} / {rings['after']:.2f}"
        lines.append(as_line(shown, [str(sum(held["images"].values())), *cells, apart]))
    return "\n".join(lines)


def fitted_images() -> str:
    """Statistics of recorded images, and of those simulated before and after the fit."""
    rows = by_name("calibrate_edge_2d")
    whens = ("real", "before", "after")
    lines = ["| | recorded | before | after |", "|---|---|---|---|"]
    for shown, (names, digits) in STATISTICS.items():
        lines.append(
            as_line(
                shown,
                [", ".join(f"{rows[name][when]:.{digits}f}" for name in names) for when in whens],
            )
        )
    for what, shown in LEFT_BEHIND.items():
        together = [
            [rows[f"{what}, slide {each} mm"] for each in names] for names in SLIDES.values()
        ]
        lines.append(
            as_line(
                shown,
                [
                    ", ".join(f"{_over_images(each, when):.1f}" for each in together)
                    for when in whens
                ],
            )
        )
    return "\n".join(lines)


def _over_images(rows: list[dict], when: str) -> float:
    return fmean([row[when] for row in rows], [row["images"] for row in rows])


def compared() -> str:
    """Simulated against recorded pins on contacts that the fit never saw."""
    rows = {name: row["value"] for name, row in by_name("validate").items()}
    lines = [
        "| | R2 of the pins' motion | left over, mm | R2 of a regression from the labels |",
        "|---|---|---|---|",
    ]
    for kind, shown in (("tap", "taps"), ("slide", "slides")):
        r2, left, ceiling = (rows[f"{name}.{kind}"] for name in ("r2", "residual_mm", "ceiling_r2"))
        lines.append(as_line(shown, [f"{r2:.2f}", f"{left:.3f}", f"{ceiling:.2f}"]))
    return "\n".join(lines)


def problems() -> str:
    """The largest errors against closed forms and other solvers, and what they may be."""
    rows = take("verify")["rows"]
    lines = ["| problem | error | bar |", "|---|---|---|"]
    for shown, (group, begins) in PROBLEMS.items():
        known = [row for row in rows if row["group"] == group and row["bar"] is not None]
        found = [[row for row in known if re.match(begin, row["problem"])] for begin in begins]
        px = found[0][0]["px"]
        scale, unit = (1, "px") if px else (100, "%")
        errors = ", ".join(
            f"{scale * max(abs(row['error']) for row in each):.2g}" for each in found
        )
        bars = [f"{scale * each[0]['bar']:g}" for each in found]
        lines.append(
            as_line(
                shown,
                [
                    f"{errors} {unit}",
                    f"{', '.join(bars if len(set(bars)) > 1 else bars[:1])} {unit}",
                ],
            )
        )
    return "\n".join(lines)


def large_strain() -> str:
    """The linear dome against a neo-Hookean one, by depth."""
    lines = [
        "| depth mm | pins move, rms | error rms / 95 % | force | radius | gel strained beyond 20 % |",
        "|---|---|---|---|---|---|",
    ]
    for row in take("verify")["rows"]:
        if row["group"].startswith("the model's own error"):
            depth, move, p95, force, radius, strained = LARGE.search(
                f"{row['problem']} {row['note']}"
            ).groups()
            cells = (
                f"{row['measured']:.2f} / {p95}",
                f"x {float(force):.2f}",
                f"x {float(radius):.2f}",
                f"{strained} %",
            )
            lines.append(as_line(depth, [move, *cells]))
    return "\n".join(lines)


def levels() -> str:
    """Time and error of a contact by level."""
    rows = {(row["name"], row["kind"]): row for row in take("bench_sim")["rows"]}
    lines = [
        "| | slide: ratio, ms | rms / 95 % px | tap: ratio, ms | rms / 95 % px |",
        "|---|---|---|---|---|",
    ]
    for name, shown in LEVELS.items():
        cells = []
        for kind in ("slide", "tap"):
            row = rows[name, kind]
            exact = name.startswith(row["against"])
            cells.append(f"{row['ratio']:.3g}, {row['ms_per_state']:.3g}")
            cells.append("0" if exact else f"{row['rms_px']:.2f} / {row['p95_px']:.2f}")
        lines.append(as_line(shown, cells))
    return "\n".join(lines)


def training() -> str:
    """Images a second in training, and the convolutions' rate over that of a matrix product."""
    lines = [
        "| images a second | jaxunshear | by XLA alone | PyTorch | PyTorch, compiled |",
        "|---|---|---|---|---|",
    ]
    for name, processor in TRAINED_ON.items():
        rows = {(row["name"], row["size"]): row for row in take(name)["rows"]}
        apart = any(kind == XLA for kind, _ in rows)  # earlier there was one form, by XLA
        kinds = (COMPILED, XLA, *TORCH) if apart else ("", COMPILED, *TORCH)
        for size in dict.fromkeys(size for _, size in rows):
            found = [rows.get((kind, size)) for kind in kinds]
            cells = [
                f"{row['images_per_s']:.1f} ({row['share']:.2f})" if row else "not measured"
                for row in found
            ]
            batch = rows[COMPILED, size]["batch"]
            lines.append(as_line(f"{processor}, {size} px, batch {batch}", cells))
    return "\n".join(lines)


def inference() -> str:
    """Milliseconds to unshear one image."""
    rows = {(row["name"], row["size"]): row for row in take("bench_infer")["rows"]}
    lines = ["| | jaxunshear | PyTorch | PyTorch, compiled |", "|---|---|---|---|"]
    for size in (256, 128):
        found = [rows[kind, size] for kind in (COMPILED, *TORCH)]
        lines.append(
            as_line(
                f"{size} px", [f"{row['ms_per_image']:.1f} ({row['ms_p95']:.1f})" for row in found]
            )
        )
    return "\n".join(lines)


def needs() -> str:
    """Operations and milliseconds of work with and without a part."""
    lines = [
        "| work | left out | Mflop, before and after | ms, before and after |",
        "|---|---|---|---|",
    ]
    for row in take("bench_needs")["rows"]:
        both = (row["with"], row["without"])
        operations = ", ".join(f"{each['operations'] / 1e6:.0f}" for each in both)
        times = ", ".join(f"{1e3 * each['seconds']:.1f}" for each in both)
        lines.append(as_line(row["name"], [row["left_out"], operations, times]))
    return "\n".join(lines)


CALIBRATION = (fits, fitted_images, compared)
SIMULATOR = (problems, large_strain, levels)
SPEED = (training, inference, needs)
