"""Tables of the simulator and of speed: what was fitted, verified and timed."""

import re
from statistics import fmean

from docs.reading import format_line, load_result, load_rows, start_table, tabulate_rows

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
# what a line shows: the group, and the beginnings of the problems, each with its largest error
PROBLEMS = {
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
    "a pad as an elastic layer: pressed; pulled, motion along and across the pull": (
        "a pad of one material against an elastic layer on a plate",
        (".*: pressed", ".*: pulled, x", ".*: pulled, y"),
    ),
    "edge passed in steps of 0.05 mm, by taps, by slides: a step against the one before": (
        "the dome",
        ("edge passed by taps", "edge passed by slides"),
    ),
}
LARGE_STRAIN = re.compile(
    r"(?P<depth>\d) mm deep.* their (?P<motion>[\d.]+) px.* p95 (?P<p95>[\d.]+).*"
    r"force x (?P<force>[\d.]+), radius x (?P<radius>[\d.]+).*beyond 20 % in (?P<strained>\d+) %"
)
REFITTED = {
    "frame": "the object's frame, found in other contacts",
    "friction": "friction",
    "skin_to_gel": "stiffness, skin : gel",
    "skin_mm": "skin's thickness, mm",
    "pin_length_mm": "pins' length, mm",
    "skin_poisson": "skin's Poisson's ratio",
    "gel_poisson": "gel's Poisson's ratio",
    "dome_radius_mm": "dome's radius, mm",
    "mm_across": "camera: mm across",
    "distance_mm": "camera: distance, mm",
    "all": "all values together",
}
LEVELS = {
    "fast, batch 64": "`fast`",
    "auto, batch 64": "`auto`",
    "auto, float64": "`auto`, float64",
    "auto, steps times 2": "`auto`, steps halved",
    "auto, nothing left out, batch 64": "`auto`, nothing left out",
    "reference, batch 64": "`reference`",
}
COMPILED, XLA, PLAIN = "jaxunshear", "jaxunshear, XLA alone", "jaxunshear, plain layers"
PROCESSORS = {"bench_train": "AMD EPYC", "bench_train_xeon": "Intel Xeon"}
TORCH = ("pytorch", "pytorch, compiled")


def tabulate_fits() -> str:
    """Tabulate what was fitted to recordings, with its interval."""
    lines = start_table(
        "| recordings | contacts | friction | skin : gel | pins apart, mm "
        "| rings apart before / after, px of 128 |"
    )
    for name, label in FITS.items():
        result = load_result(name)
        parameters = {row["name"]: row for row in result["parameters"]}
        cells = [str(sum(result["images"].values()))]
        for parameter, digits in FITTED.items():
            row = parameters[parameter]
            low, high = row["low"], row["high"]
            fit = f"{row['after']:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
            cells.append(fit if row["determined"] else "not determined")
        rings = result["ring_error_px"]
        cells.append(f"{rings['before']:.1f} / {rings['after']:.2f}")
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def tabulate_fitted_images() -> str:
    """Tabulate statistics of recorded images, and of those simulated before and after the fit."""
    rows = load_rows("calibrate_edge_2d")
    columns = ("real", "before", "after")
    lines = start_table("| | recorded | before | after |")
    for label, (names, digits) in STATISTICS.items():
        cells = []
        for column in columns:
            cells.append(", ".join(f"{rows[name][column]:.{digits}f}" for name in names))
        lines.append(format_line(label, cells))
    for statistic, label in LEFT_BEHIND.items():
        cells = []
        for column in columns:
            means = []
            for lengths in SLIDES.values():
                selected = [rows[f"{statistic}, slide {length} mm"] for length in lengths]
                weights = [row["images"] for row in selected]
                means.append(f"{fmean([row[column] for row in selected], weights):.1f}")
            cells.append(", ".join(means))
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def tabulate_validation() -> str:
    """Tabulate simulated against recorded pins on contacts that the fit never saw."""
    rows = load_rows("validate")
    lines = start_table(
        "| | R2 of the pins' motion | left over, mm | R2 of a regression from the labels |"
    )
    for kind, label in (("tap", "taps"), ("slide", "slides")):
        r2 = rows[f"r2.{kind}"]["value"]
        residual_mm = rows[f"residual_mm.{kind}"]["value"]
        ceiling = rows[f"ceiling_r2.{kind}"]["value"]
        lines.append(format_line(label, [f"{r2:.2f}", f"{residual_mm:.3f}", f"{ceiling:.2f}"]))
    return "\n".join(lines)


def tabulate_refit() -> str:
    """Tabulate what the simulator gains on contacts kept out, by each value that was refitted."""
    values = {name: row["value"] for name, row in load_rows("validate_refit").items()}
    lines = start_table("| changed | before | after | R2 gained, taps | R2 gained, slides |")
    for name, label in REFITTED.items():
        cells = []
        for time in ("before", "after"):
            key = f"{time}.{name}"
            cells.append(f"{values[key]:.3g}" if key in values else "")
        cells += [f"{values[f'gain.r2.{kind}.{name}']:+.3f}" for kind in ("tap", "slide")]
        lines.append(format_line(label, cells))
    for prefix, label in (("before.", "R2 before the refit, frame found"), ("", "R2 after it")):
        scores = [f"{values[f'{prefix}r2.{kind}']:.3f}" for kind in ("tap", "slide")]
        lines.append(format_line(label, ["", "", *scores]))
    return "\n".join(lines)


def tabulate_problems() -> str:
    """Tabulate the largest errors against closed forms and other solvers, with their limits."""
    lines = start_table("| problem | error | bar |")
    rows = load_result("verify")["rows"]
    for label, (group, starts) in PROBLEMS.items():
        limited = [row for row in rows if row["group"] == group and row["bar"] is not None]
        errors, bars = [], []
        for start in starts:
            selected = [row for row in limited if re.match(start, row["problem"])]
            scale, unit = (1, "px") if selected[0]["px"] else (100, "%")
            errors.append(f"{scale * max(abs(row['error']) for row in selected):.2g}")
            bars.append(f"{scale * selected[0]['bar']:g}")
        if len(set(bars)) == 1:
            bars = bars[:1]
        lines.append(
            format_line(label, [f"{', '.join(errors)} {unit}", f"{', '.join(bars)} {unit}"])
        )
    return "\n".join(lines)


def tabulate_large_strain() -> str:
    """Tabulate the linear dome against a neo-Hookean one, by depth."""
    lines = start_table(
        "| depth mm | pins move, rms | error rms / 95 % | force | radius "
        "| gel strained beyond 20 % |"
    )
    for row in load_result("verify")["rows"]:
        if row["group"].startswith("the model's own error"):
            match = LARGE_STRAIN.search(f"{row['problem']} {row['note']}")
            cells = [
                match["motion"],
                f"{row['measured']:.2f} / {match['p95']}",
                f"x {float(match['force']):.2f}",
                f"x {float(match['radius']):.2f}",
                f"{match['strained']} %",
            ]
            lines.append(format_line(match["depth"], cells))
    return "\n".join(lines)


def tabulate_levels() -> str:
    """Tabulate time and error of a contact by level."""
    rows = {(row["name"], row["kind"]): row for row in load_result("bench_sim")["rows"]}
    lines = start_table("| | slide: ratio, ms | rms / 95 % px | tap: ratio, ms | rms / 95 % px |")
    for name, label in LEVELS.items():
        cells = []
        for kind in ("slide", "tap"):
            row = rows[name, kind]
            is_reference = name.startswith(row["against"])
            error = f"{row['rms_px']:.2f} / {row['p95_px']:.2f}"
            cells.append(f"{row['ratio']:.3g}, {row['ms_per_state']:.3g}")
            cells.append("0" if is_reference else error)
        lines.append(format_line(label, cells))
    return "\n".join(lines)


def tabulate_training() -> str:
    """Tabulate images per second in training, and the rate over that of a matrix product."""
    forms = ["jaxunshear", "by XLA alone", "plain layers", "PyTorch", "PyTorch, compiled"]
    lines = start_table(format_line("images a second", forms))
    for name, processor in PROCESSORS.items():
        rows = {(row["name"], row["size"]): row for row in load_result(name)["rows"]}
        separate = any(kind == XLA for kind, _ in rows)  # earlier there was one form, by XLA
        kinds = (COMPILED, XLA, PLAIN, *TORCH) if separate else ("", COMPILED, "", *TORCH)
        for size in dict.fromkeys(size for _, size in rows):
            cells = []
            for kind in kinds:
                row = rows.get((kind, size))
                rate = f"{row['images_per_s']:.1f} ({row['share']:.2f})" if row else "not measured"
                cells.append(rate)
            batch = rows[COMPILED, size]["batch"]
            lines.append(format_line(f"{processor}, {size} px, batch {batch}", cells))
    return "\n".join(lines)


def tabulate_inference() -> str:
    """Tabulate milliseconds to unshear one image."""
    rows = {(row["name"], row["size"]): row for row in load_result("bench_infer")["rows"]}
    lines = start_table("| | jaxunshear | PyTorch | PyTorch, compiled |")
    for size in (256, 128):
        times = []
        for kind in (COMPILED, *TORCH):
            row = rows[kind, size]
            times.append(f"{row['ms_per_image']:.1f} ({row['ms_p95']:.1f})")
        lines.append(format_line(f"{size} px", times))
    return "\n".join(lines)


def tabulate_omissions() -> str:
    """Tabulate operations and milliseconds of work with and without a part."""
    rows = []
    for row in load_result("bench_needs")["rows"]:
        both = (row["with"], row["without"])
        operations = ", ".join(f"{each['operations'] / 1e6:.0f}" for each in both)
        times = ", ".join(f"{1e3 * each['seconds']:.1f}" for each in both)
        rows.append(row | {"operations": operations, "times": times})
    header = "| work | left out | Mflop, before and after | ms, before and after |"
    return tabulate_rows(header, rows, "{name}", "{left_out}", "{operations}", "{times}")
