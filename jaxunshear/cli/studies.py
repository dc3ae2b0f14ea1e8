"""Commands about recordings, finished runs, sensors and stimuli."""

import argparse
from pathlib import Path

from jaxunshear.cli.program import (
    DATA,
    LAYOUT,
    ROWS,
    WITHOUT,
    Command,
    define_command,
    flag,
    integer,
    json_file,
    path,
    write_measurement,
)
from jaxunshear.config.serialization import check_finished_run, check_unreleased, load_task_settings
from jaxunshear.errors import UserError
from jaxunshear.files import to_builtins, write_bytes, write_json
from jaxunshear.output_checks import (
    check_new_file,
    check_new_folder,
    check_not_among,
    check_outside,
)

COMPARE_OUT = Path("runs/compare")
FOUND = "what was found, with command, machine and versions"  # what `--json` writes


RUN = path("run", "MODEL", "folder of a finished run, such as runs/demo")
TABLES = path("--tables", "DIR", "also write every table of the page as CSV and LaTeX")
CATALOGUE_OPTIONS = (
    ("action", {"choices": ("list", "draw"), "nargs": "?", "default": "list"}),
    ("name", {"metavar": "NAME", "nargs": "?", "help": "what to draw"}),
    path("--out", "FILE", "PNG, SVG or PDF to draw to (default: NAME.png)"),
)


@define_command(
    "check a folder of recordings and suggest the next command",
    path("path", "RECORDINGS", "a folder of recordings, one above several, or an image"),
    LAYOUT,
    WITHOUT,
    json_file(FOUND),
)
def doctor(arguments: argparse.Namespace, command: str) -> int:
    """Run the command; return 0, or 1 if no command can use the frames."""
    from jaxunshear.doctor import check_recordings, describe

    diagnosis = check_recordings(arguments.path, arguments.without, arguments.layout)
    print("\n".join(describe(diagnosis)))
    write_measurement(arguments.json, command, to_builtins(diagnosis))
    return 0 if diagnosis.usable else 1


@define_command(
    "find the layout of a sensor's markers, if it is not a known one",
    path("path", "RECORDINGS", "frames of the untouched sensor, or taps"),
    path("--out", "FILE", "new file of the layout, as JSON", dest="file", required=True),
    json_file(FOUND),
)
def layout(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.results.layout import read_layout
    from jaxunshear.results.record_files import write_record

    file = arguments.file
    if file.is_file():
        try:
            read_layout(file)
        except UserError:
            raise UserError(f"--out {file} is there, and is no layout: name another file") from None
    else:
        check_new_file(file, "--out")
    check_outside(file, "--out")
    from jaxunshear.data.layout_finding import describe_layout, find_layout

    found = find_layout(arguments.path, file.stem)
    write_record(file, found.layout)
    print("\n".join([*describe_layout(found), str(file)]))
    write_measurement(arguments.json, command, to_builtins(found))
    return 0


@define_command(
    "fit the simulator's camera, pins, friction and stiffness to recordings",
    path("recordings", "RECORDINGS", "a folder of labelled recordings"),
    path("--out", "DIR", "folder for calibration.json, its tables and a picture"),
    json_file(ROWS),
)
def calibrate(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.calibration.calibrate import calibrate

    if arguments.out is not None:
        check_not_among(arguments.recordings, arguments.out, "--out")
    result = calibrate(arguments.recordings, arguments.out)
    rows = result["rows"] + result["parameters"]
    write_measurement(arguments.json, command, result | {"rows": rows})
    return 0


@define_command(
    "compare simulated with recorded pin motion, contact by contact",
    path("recordings", "RECORDINGS", "a folder of labelled recordings"),
    path("--calibration", "FILE", "calibration.json of `calibrate` (default: the fitted preset)"),
    integer("--contacts", "contacts to draw from each folder; 0: all (default: 400)", 400),
    integer("--seed", "seed of the draw (default: 0)", 0),
    path("--out", "DIR", "folder for validate.png and validate.txt"),
    json_file(ROWS),
)
def validate(arguments: argparse.Namespace, command: str) -> int:
    if arguments.out is not None:
        check_not_among(arguments.recordings, arguments.out, "--out")
    contacts, seed, calibration = arguments.contacts, arguments.seed, arguments.calibration
    if contacts < 0:
        raise UserError(f"--contacts {contacts}: use 1 or more, or 0 for all")
    if seed < 0:
        raise UserError(f"--seed {seed}: use 0 or more")
    from jaxunshear.calibration.prediction import DEFAULT_CALIBRATION, read_calibration
    from jaxunshear.calibration.validate import validate

    fitted = DEFAULT_CALIBRATION if calibration is None else read_calibration(calibration)
    result = validate(arguments.recordings, fitted, contacts or None, seed, arguments.out)
    write_measurement(arguments.json, command, {"seed": seed, **result})
    return 0


@define_command(
    "write the HTML page of a finished run",
    RUN,
    TABLES,
    path("--figures", "DIR", "also write every plot of the page as PDF"),
    computes=False,
)
def report(arguments: argparse.Namespace, command: str) -> int:
    check_new_folder(arguments.tables, "--tables")
    check_new_folder(arguments.figures, "--figures")
    check_finished_run(arguments.run)
    from jaxunshear.report.figures import write_figures
    from jaxunshear.report.report import write_report
    from jaxunshear.style import collect_figures

    with collect_figures() as drawn:
        page = write_report(arguments.run)
    print(page)
    _write_tables(page, arguments)
    if arguments.figures:
        written = write_figures(page, drawn, arguments.figures)
        print(f"{len(written)} figures: {arguments.figures}")
    return 0


@define_command(
    "compare finished runs: settings that differ, scores with intervals, times",
    path("runs", "MODEL", "folders of finished runs; the first is the reference", nargs="+"),
    path("--out", "DIR", f"folder of the page (default: {COMPARE_OUT})", default=COMPARE_OUT),
    TABLES,
)
def compare(arguments: argparse.Namespace, command: str) -> int:
    check_new_folder(arguments.tables, "--tables")
    from jaxunshear.compare import write_comparison

    text, page = write_comparison(arguments.runs, arguments.out)
    print(text)
    print(f"page: {page}")
    _write_tables(page, arguments)
    return 0


def _write_tables(page: Path, arguments: argparse.Namespace) -> None:
    if arguments.tables:
        from jaxunshear.report.tables import write_tables

        written = write_tables(page, arguments.tables)
        print(f"{len(written)} files of tables: {arguments.tables}")


@define_command(
    "pack the weights of a finished run for reuse, with a model card",
    RUN,
    path("--out", "DIR", "a new folder; its name is the weights'", required=True),
)
def release(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.release import release

    print(release(arguments.run, arguments.out))
    return 0


@define_command(
    "adapt a run over pins to another day or a moved camera, by labelled taps alone",
    path("run", "MODEL", "folder of a finished run over pins, such as runs/fit"),
    path("--taps", "RECORDINGS", "50 labelled taps or more of that day", required=True),
    path("--out", "DIR", "a new folder, for the adapted run", required=True),
    DATA,
)
def adapt(arguments: argparse.Namespace, command: str) -> int:
    """Adapt a run to another day, and print how its pins stand there."""
    from jaxunshear.adapt import adapt

    moved = adapt(arguments.run, arguments.taps, arguments.out, arguments.data)
    print(
        "pins are shifted by ({:.2f}, {:.2f}) px, turned by {:.2f} deg, and further moved by "
        "{:.2f} px rms".format(*moved.shift_px, moved.turn_deg, moved.left_px)
    )
    print(arguments.out)
    return 0


@define_command(
    "test what the latent codes contain: swap, blank and exchange them (the paper's appendix D)",
    RUN,
    DATA,
    flag("--leakage", "measure by probes what each code holds that it should not"),
    json_file(),
)
def ablate(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.evaluation import code_swaps, codes, leakage

    check_unreleased(arguments.run)
    experiment = load_task_settings(arguments.run)
    if arguments.leakage:
        from jaxunshear.report.leakage_figure import plot_leakage

        results = leakage.measure_leakage(experiment, arguments.run, arguments.data, command)
        exchange = codes.exchange_codes(experiment, arguments.run, arguments.data)
        write_bytes(arguments.run / "leakage.png", plot_leakage(results, exchange))
        print(leakage.format_table(results))
        print(arguments.run / "leakage.png")
    else:
        results = code_swaps.ablate(experiment, arguments.run, arguments.data, command)
        print(code_swaps.format_table(results["rows"]))
    if arguments.json:
        write_json(arguments.json, results)
    return 0


def catalogue(arguments: argparse.Namespace, command: str) -> int:
    """List or draw the sensors or the stimuli."""
    from jaxunshear.catalogue import draw, format_listing, list_names

    kind, name = arguments.command, arguments.name
    if arguments.action == "list":
        if name or arguments.out:
            raise UserError(
                f"`list` takes nothing more; to draw: jaxunshear {kind} draw NAME --out FILE"
            )
        print(format_listing(kind))
        return 0
    if not name:
        raise UserError(f"name what to draw: {', '.join(list_names(kind))}")
    out = arguments.out or Path(f"{name}.png")
    draw(kind, name, out)
    print(out)
    return 0


COMMANDS = (
    doctor,
    layout,
    calibrate,
    validate,
    report,
    compare,
    release,
    adapt,
    ablate,
    *(
        Command(name, f"list or draw the {name}", catalogue, CATALOGUE_OPTIONS, computes=False)
        for name in ("sensors", "stimuli")
    ),
)
