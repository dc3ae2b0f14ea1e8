"""The page of a comparison, and its few lines for a terminal."""

from collections.abc import Sequence

from markupsafe import Markup

from jaxunshear.compare.contacts import Contacts
from jaxunshear.compare.curves import curves
from jaxunshear.compare.figures import Compared, main_figures
from jaxunshear.compare.runs import OWN, Run
from jaxunshear.evaluation.score import BASELINES
from jaxunshear.progress import duration
from jaxunshear.report import page, pictures, words
from jaxunshear.results.sweep import Figure
from jaxunshear.table import plain_table

GROUPS = {  # table of results: heading, lead
    "ms_ssim": ("How alike the images are", "MS-SSIM of an image with the tap's; 1 is equal."),
    "pose": ("What a pose network reads", "Mean absolute errors of a PoseNet."),
    "pose_recovery": (
        "Recovery",
        "The share of the slide's damage undone, (sheared - unsheared) / (sheared - tap). 1 is as good as taps.",
    ),
    "pins": ("How far pins are from the tap's", "Root mean square px, pins known by name."),
    "pin_error": ("Pins found in the images", "Centroids matched with the tap's pins; of few images, so no interval."),
}
FOLDED = (*BASELINES, "missed_per_image", "extra_per_image")  # in the table of all other figures
DIGITS = {"ms_ssim": 3, "pose_recovery": 2}  # 3 of mm, 2 of degrees and px
PAIRED = (
    "Brackets: 95 % bootstrap intervals over test poses, each with all its slides. Differences are of pairs: both runs were scored on the "
    "same contacts, and each resample draws the same poses for both."
)
ONE_TRAINING = (
    "An interval over poses alone says nothing of another training: with another seed, each run would give other figures, and a difference "
    "that is clear here may be that of two seeds. `jaxunshear sweep FILE --seeds 0,1,2` gives intervals over seeds and poses."
)


def document(
    runs: Sequence[Run],
    apart: dict[str, list[str]],
    every: Sequence[Compared],
    shown: Contacts | None,
    notes: Sequence[str],
) -> str:
    """The complete page; the same runs give the same bytes."""
    names = [run.name for run in runs]
    parts: list[Markup | str] = [_heading(names, notes), _settings(names, apart)]
    parts += [_group(runs, every, table) for table in GROUPS]
    parts += [_montage(names, shown) if shown else "", _training(runs), _others(runs, every), _provenance(runs)]
    return page.page(f"jaxunshear: {' and '.join(names)}", *filter(None, parts))


def _heading(names: Sequence[str], notes: Sequence[str]) -> Markup:
    lead = f"Differences are of the other runs less {names[0]}, the reference. {PAIRED}"
    return page.compared(names, notes, lead, ONE_TRAINING)


def _settings(names: Sequence[str], apart: dict[str, list[str]]) -> Markup:
    if not apart:
        return page.section("Settings that differ", "None: all runs have the same.")
    rows = [[name, *values] for name, values in apart.items()]
    lead = "By name, as a command line takes them; all others are the same. A dash: the run has no such setting."
    return page.section("Settings that differ", lead, page.table(["", *names], rows))


def _group(runs: Sequence[Run], every: Sequence[Compared], table: str) -> Markup | str:
    """The figures of one table of results on all contacts, in the order of the kinds that a report has."""
    rows = [figure for figure in every if figure.table == table and _is_chief(figure)]
    if not rows:
        return ""
    order = [*words.KINDS, OWN]
    place = {kind: index for index, kind in enumerate(order)}
    rows.sort(key=lambda figure: place.get(_kind(figure), len(order)))
    title, lead = GROUPS[table]
    lines = [[_called(runs[0], figure), *_cells(figure)] for figure in rows]
    strong = [index for index, figure in enumerate(rows) if _kind(figure) in (OWN, runs[0].shown)]
    return page.section(title, lead, page.table(_head(runs), lines, (), strong))


def _is_chief(figure: Compared) -> bool:
    """Whether it has a table of its own."""
    return figure.table in GROUPS and ": " not in figure.name and not set(figure.name.split("/")) & set(FOLDED)


def _kind(figure: Compared) -> str:
    return figure.name.split("/")[1]


def _head(runs: Sequence[Run]) -> list[str]:
    less = (Markup("{}<br>less {}").format(run.name, runs[0].name) for run in runs[1:])
    return ["", *(run.name for run in runs), *less]


def _called(first: Run, figure: Compared) -> str:
    """A row's name in words."""
    _, kind, *column = figure.name.split("/")
    said = "unsheared, by each run's own network" if kind == OWN else _word(first, kind)
    return said + (f": {words.word(column[0])}, {words.unit(column[0])}" if column else "")


def _word(first: Run, kind: str) -> str:
    known = words.KINDS if first.results.simulated else words.KINDS | words.OF_RECORDINGS
    return known.get(kind, kind)


def _cells(figure: Compared) -> list[str]:
    digits = DIGITS.get(figure.table, 3 if figure.name.endswith("_mm") or ": " in figure.name else 2)
    values = [page.number(None) if of is None else page.spanned(of.mean, of.interval, digits) for of in figure.of]
    return [*values, *(_less(figure, run, digits) for run in range(1, len(figure.of)))]


def _less(figure: Compared, run: int, digits: int) -> str:
    """A difference, its interval and its verdict."""
    less = figure.less[run]
    if less is None:
        return page.number(None)
    if less.mean == 0 and less.interval in (None, [0, 0]):
        return "equal"
    colour = {"better": "good", "worse": "bad"}.get(verdict := figure.verdict(run), "soft")
    return page.difference(page.spanned(less.mean, less.interval, digits + 1), verdict, colour)


def _montage(names: Sequence[str], shown: Contacts) -> Markup:
    heads = ["sheared (input)", *names, shown.truth]
    rows = []
    for row, (first, *more) in enumerate(shown.said):
        cells = [(pictures.png_address(shown.sheared[row]), heads[0], "")]
        for name, images, likeness in zip(names, shown.unsheared, shown.likeness, strict=True):
            if images is None or likeness is None or not images[row].any():
                cells.append(("", name, "\u2013"))
            else:
                cells.append((pictures.png_address(images[row]), name, f"{likeness[row]:.3f}"))
        cells.append((pictures.png_address(shown.tap[row]), heads[-1], ""))
        rows.append((first, more, cells))
    lead = "Contacts that are typical of the reference's test, one of each shape; numbers are MS-SSIM with what stands on the right."
    title = "The same contacts, unsheared by each run"
    return page.section(title, lead, page.montage(heads, rows), *map(page.soft, shown.notes))


def _training(runs: Sequence[Run]) -> Markup:
    rows = [
        [network, run.name, *_ending(run, network)]
        for network in dict.fromkeys(network for run in runs for network in run.histories)
        for run in runs
        if network in run.histories
    ]
    if not rows:
        return page.section("Training", "No run has a training log.")
    head = ["network", "run", "epochs", "steps", "best at step", "images/s", "training", "trained on"]
    drawn = page.drawing(curves(runs), "losses of each network in each run, over epochs and over seconds")
    lead = "The main loss of each network on validation (thick) and in training (thin), over epochs and over seconds of training."
    return page.section("Training", lead, drawn, page.table(head, rows))


def _ending(run: Run, network: str) -> list[str]:
    history, ending = run.histories[network], run.endings.get(network)
    if ending is None:
        return [f"{history.epoch[-1]:.3g}", *3 * ["\u2013"], duration(history.train_seconds[-1]), "\u2013"]
    machine = ending.trained_on
    return [
        f"{history.epoch[-1]:.3g}",
        str(ending.steps),
        str(ending.best_step),
        f"{ending.images_per_second:.3g}",
        duration(history.train_seconds[-1]),
        f"{machine.device}, {machine.cores} cores" if machine.device else "\u2013",
    ]


def _others(runs: Sequence[Run], every: Sequence[Compared]) -> Markup | str:
    """All that no table above has, folded away, by its name in results and sweeps."""
    rest = [figure for figure in every if not _is_chief(figure)]
    if not rest:
        return ""
    rows = [[figure.name, *_cells(figure)] for figure in rest]
    folded = page.folded(f"{len(rest)} figures", page.table(_head(runs), rows))
    return page.section(
        "All other figures", "Shapes one by one, tests of their own, baselines, readers, decoders.", folded
    )


def _provenance(runs: Sequence[Run]) -> Markup:
    rows = []
    for run in runs:
        machine, versions = run.results.machine, run.results.versions
        said = f"{machine.processor}, {machine.cores} cores, {machine.device}"
        made = [versions.get(package, "\u2013") for package in ("jaxunshear", "jax")]
        made[0] += f", commit {source.commit[:7]}" if (source := run.results.source) and source.commit else ""
        rows.append([run.name, str(run.folder), said, *made])
    commands = "\n".join(f"{run.name}: {run.results.command}" for run in runs)
    table = page.table(["run", "folder", "evaluated on", "jaxunshear", "jax"], rows)
    return page.section("Where they are from", "Folders, machines, versions and commands.", table, page.code(commands))


def lines(runs: Sequence[Run], apart: dict[str, list[str]], every: Sequence[Compared], notes: Sequence[str]) -> str:
    """What fits a terminal: the main figures, and which settings differ."""
    table = [
        {"": figure.name}
        | {run.name: _short(of) for run, of in zip(runs, figure.of, strict=True)}
        | {f"{run.name} less": _short(figure.less[index], "+") for index, run in enumerate(runs) if index}
        for figure in main_figures(runs, every)
    ]
    columns = ["", *(run.name for run in runs), *(f"{run.name} less" for run in runs[1:])]
    shown = ", ".join(list(apart)[:6]) + (f" and {len(apart) - 6} more" if len(apart) > 6 else "")
    said = f"settings that differ: {shown}" if apart else "no setting differs"
    return "\n".join(
        [*notes, plain_table(table, columns), f"{said}; brackets: 95 % over test poses of one training each"]
    )


def _short(figure: Figure | None, sign: str = "") -> str | None:
    if figure is None:
        return None
    value = f"{figure.mean:{sign}.3g}"
    return f"{value} [{figure.interval[0]:.3g}, {figure.interval[1]:.3g}]" if figure.interval else value
