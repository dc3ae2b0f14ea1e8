"""Recordings in, how far the simulated pins follow the recorded ones out; see `validation` for what is compared.

results = validate(Path("recordings/edge"))
results["rows"]  # [{"name": "r2.tap", "unit": "1", "value": 0.71, "contacts": 398}, ...]
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from jaxunshear.calibration.calibrate import IMAGES
from jaxunshear.calibration.calibrated import SHIPPED, Calibrated
from jaxunshear.calibration.folders import Folder, align, compare, read_folder
from jaxunshear.calibration.gains import Scored, gains, gains_table, refitted
from jaxunshear.calibration.held_out import Parts, held_out
from jaxunshear.calibration.labels import Frame
from jaxunshear.calibration.sampling import sample
from jaxunshear.calibration.validation import Row, rows_of
from jaxunshear.errors import UserError
from jaxunshear.storage import Json, write_bytes, write_json, write_text

EACH = 400  # contacts of a folder
FITTED_TO = (
    "edge_2d/shear/csv_train",
    "edge_2d/tap/csv_train",
)  # what the shipped preset was fitted to, of IMAGES and seed 0
CEILING = "ceiling: a regression from the labels of these contacts, which more of them raise: from few it may lie below"
GAINED = (
    "r2 gained: on contacts that the refit never saw, by this value alone with the object's frame found anew; frame: by finding it, "
    "before the refit; all: by the full refit"
)

Log = Callable[[str], None]


def validate(
    path: Path,
    calibrated: Calibrated = SHIPPED,
    each: int | None = EACH,
    seed: int = 0,
    out: Path | None = None,
    log: Log = print,
    as_labelled: bool = False,
    refit: Path | None = None,
) -> Json:
    """Compares `each` contacts of every folder at `path` (None: all), drawn at random, that the calibration has not seen.

    `as_labelled`: with edge and tilt of the object where the labels have them. `refit`: a file for the calibration, refitted pin by pin
    to the images that align the folders, which is then compared; rows say what each value gained.

    Returns `rows` (name, unit, value, contacts), `notes`, and `left_out` (image, why). With `out`, writes validate.txt and
    validate.png there, which show no recorded image. Raises `UserError` where nothing can be compared.
    """
    path = Path(path)
    notes: list[str] = [f"{calibrated.name}; contacts drawn with seed {seed}"]
    used = _used(path, calibrated, notes)
    split, more = held_out(path, each, seed, used)
    notes += more
    folders, left_out = _folders(split, calibrated, notes)
    scored, lost = _scored(folders, calibrated, as_labelled, [folder.start for folder in folders], notes)
    if not scored:
        raise UserError(f"{path}: no folder has labelled contacts that can be compared: {notes[-1]}")
    gained: list[Row] = []
    if refit is not None:
        folders, aligned = [part.folder for part in scored], [part.aligned for part in scored]
        known, frames = refitted(folders, calibrated, used, aligned, as_labelled)
        write_json(
            refit, {"preset": known.preset, "image_names": known.used, "notes": [f"{calibrated.name}, refitted"]}
        )
        notes.append(f"{refit.name}: refitted to the contacts that align; the rest of this is of it")
        again, lost = _scored(folders, known, as_labelled, frames, notes)
        if not again:
            raise UserError(f"{path}: after the refit no folder can be compared: {notes[-1]}")
        gained = gains(scored, again, calibrated, known, as_labelled)
        scored = again
    left_out += lost
    for why in sorted({one["why"] for one in left_out}):
        names = [one["image"] for one in left_out if one["why"] == why]
        notes.append(f"{len(names)} left out, {why}: {', '.join(names[:5])}{' ...' if len(names) > 5 else ''}")
    notes += [CEILING, GAINED] if gained else [CEILING]
    compared = [part.compared for part in scored]
    rows = rows_of(compared)
    tables = [table(rows), gains_table(gained)] if gained else [table(rows)]
    text = "\n\n".join(tables) + "\n" + "".join(f"\nnote: {note}" for note in notes)
    log(text)
    if out is not None:
        from jaxunshear.calibration.validate_figure import validate_figure

        write_text(Path(out) / "validate.txt", text + "\n")
        write_bytes(Path(out) / "validate.png", validate_figure(compared))
    return {"rows": rows + gained, "notes": notes, "left_out": left_out}


def table(rows: list[Json]) -> str:
    """A line for taps, slides and each part of them."""
    from jaxunshear.table import plain_table

    lines: dict[str, Json] = {}
    for row in rows:
        measure, _, part = row["name"].partition(".")
        lines.setdefault(part, {"contacts of": part, "contacts": row["contacts"]})[measure] = row["value"]
    columns = ("contacts of", "contacts", "r2", "ceiling_r2", "residual_px", "residual_mm", "motion_px")
    return plain_table(list(lines.values()), columns)


def _used(path: Path, calibrated: Calibrated, notes: list[str]) -> tuple[str, ...]:
    """Names of the images that a calibration was fitted to."""
    if calibrated.used is not None:
        if not calibrated.used:
            notes.append("the calibration does not name its images: some of them may be compared")
        return calibrated.used
    parts, _ = sample(path, IMAGES, 0)
    fitted = [part for part in parts if any(f"/{known}".endswith(f"/{part.name}") for known in FITTED_TO)]
    return tuple(name for part in fitted for name in part.names)


def _folders(split: list[Parts], calibrated: Calibrated, notes: list[str]) -> tuple[list[Folder], list[dict[str, str]]]:
    """The folders whose labels go with their images, with a note on the others, and the images left out."""
    folders, left_out = [], []
    for parts in split:
        folder, lost = read_folder(parts, calibrated)
        left_out += lost
        if isinstance(folder, str):
            notes.append(f"{parts.scored.name}: {folder}")
        else:
            folders.append(folder)
    return folders, left_out


def _scored(
    folders: list[Folder], known: Calibrated, as_labelled: bool, begin: Sequence[Frame], notes: list[str]
) -> tuple[list[Scored], list[dict[str, str]]]:
    """The folders aligned, from the frames `begin`, and compared, with notes, and the images left out."""
    found, left_out = [], []
    for folder, start in zip(folders, begin, strict=True):
        aligned = align(folder, known, as_labelled, start)
        notes.append(f"{folder.name}: {aligned.note}")
        compared, lost = compare(folder, aligned, known)
        left_out += lost
        if compared is None:
            notes.append(f"{folder.name}: too few contacts converged")
        else:
            found.append(Scored(folder, aligned, compared))
    return found, left_out
