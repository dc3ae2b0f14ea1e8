"""Adapt a finished run over pins to another day by taps alone: `jaxunshear adapt`.

>>> adapt(Path("runs/edge"), Path("recordings/monday_taps"), Path("runs/edge_monday"), data)

The renderer says where the pins of each tap should stand. The mean difference of each pin moves the
frame of all networks; nothing is trained.
"""

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import uses_pins
from jaxunshear.config.networks import POSENET, TRAINABLE
from jaxunshear.config.serialization import check_finished_run, load_task_settings, to_json
from jaxunshear.config.targets import read_true_values
from jaxunshear.data.pairing import take_rows
from jaxunshear.data.reader import Batch
from jaxunshear.data.recorded_contacts import compute_digest
from jaxunshear.data.recorded_set import read_other_recordings
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.files import read_object, write_json
from jaxunshear.metrics import compute_pose_errors
from jaxunshear.models import pin_networks, posenet
from jaxunshear.results.record_files import read_record, write_record
from jaxunshear.results.run import EVALUATE_REMEDY, FullTable, Results
from jaxunshear.training.checkpoint import FRAME_SHIFT, MODEL, load_network, move_network
from jaxunshear.training.examples import FRAME, HelperLoader

MIN_TAPS = 20
MIN_SEEN = 10  # taps that show a pin, for a mean of its own


class PinMotion(NamedTuple):
    """How pins stand elsewhere than on the day of the training."""

    motion_px: Float[np.ndarray, "P 2"]
    shift_px: np.ndarray  # (2,), of all pins
    turn_deg: float  # of all pins
    left_px: float  # root mean square of what shift and turn leave of the motion


class LabelledTaps(NamedTuple):
    """Taps of another day, and the digest of their folder."""

    rows: Batch
    digest: str


def fit_pin_motion(
    motions: Float[np.ndarray, "N P 2"], rest: Float[np.ndarray, "P 2"]
) -> PinMotion:
    """Take the mean of each pin's motions, NaN where unknown.

    Pins that fewer than MIN_SEEN taps show get a shift and a turn, fitted to the others.
    """
    is_seen = np.isfinite(motions).all(axis=2).sum(axis=0) >= MIN_SEEN
    mean, offset = np.nanmean(motions[:, is_seen], axis=0), rest - rest[is_seen].mean(axis=0)
    shift = mean.mean(axis=0)
    across = np.stack([-offset[:, 1], offset[:, 0]], axis=-1)
    turn = np.sum((mean - shift) * across[is_seen]) / np.square(across[is_seen]).sum()
    motion = shift + turn * across
    left = np.square(mean - motion[is_seen]).sum(axis=1)
    motion[is_seen] = mean
    return PinMotion(motion, shift, float(np.degrees(turn)), float(np.sqrt(left.mean())))


def adapt(run: Path, taps: Path, out: Path, data_dir: Path) -> PinMotion:
    """Write the run to `out`, adapted to labelled taps of another day; return the pins' motion.

    Half-widths grow by as much as PoseNet errs more on these taps than on the run's own. Raises
    UserError, and then leaves nothing behind.
    """
    check_finished_run(run)
    if out.exists():
        raise UserError(f"--out {out} exists: name a new folder")
    experiment = load_task_settings(run)
    if not (uses_pins(experiment) and open_source(experiment).has_frame):
        raise UserError(f"{run}: name a run that learnt from recorded pins")
    rows, digest = _read_taps(cast(Recorded, experiment.paired), run, taps, data_dir)
    render = HelperLoader(experiment, data_dir, run).load_renderer()
    frame = read_object(run / FRAME)
    place = np.array(frame["place_px"])
    moved = fit_pin_motion(rows["pins"] - render(rows["pose"]), place)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as folder_of_part:
        part = Path(folder_of_part) / out.name
        for folder in run.iterdir():
            if folder.name in TRAINABLE and (folder / MODEL).is_file():
                stored = read_object(folder / MODEL)
                shift = np.array(stored.get(FRAME_SHIFT, (0.0, 0.0))) - moved.motion_px
                changes = {"data": sorted({*stored["data"], digest})}
                move_network(folder, part / folder.name, changes, shift.tolist())
        write_json(part / FRAME, frame | {"place_px": (place + moved.motion_px).round(4).tolist()})
        write_json(part / "experiment.json", to_json(replace(experiment, name=out.name)))
        results = read_record(run / "results.json", Results, EVALUATE_REMEDY)
        widths = _widen(results, _measure_tap_errors(part, rows))
        write_record(
            part / "results.json", replace(results, half_width=widths, trained_in=run.name)
        )
        part.rename(out)
    return moved


def _read_taps(settings: Recorded, run: Path, taps: Path, data_dir: Path) -> "LabelledTaps":
    """Read labelled taps whose pins are identified, and the digest of their folder."""
    digest = compute_digest((str(taps),))
    settings = replace(settings, tap_folder=str(taps), slide_folder="", digest=digest, pairs="")
    folder = Path(data_dir) / ".partial" / f"adapt-{digest}"
    stored = read_other_recordings(settings, read_object(run / FRAME), folder)
    rows = stored.read_labelled_taps("test")
    shutil.rmtree(folder, ignore_errors=True)
    rows = take_rows(rows, rows["sure"] == 1)
    if len(rows["pose"]) < MIN_TAPS:
        raise UserError(
            f"{taps}: of {stored.metadata['counts']['contacts']} taps {len(rows['pose'])} have a "
            f"label and pins that are identified: record at least {MIN_TAPS}"
        )
    return LabelledTaps(rows, digest)


def _measure_tap_errors(run: Path, rows: Batch) -> dict[str, float]:
    """Measure the mean absolute error of PoseNet on taps, by quantity."""
    net, variables, targets = load_network(run / POSENET)
    outputs = pin_networks.predict(net, variables, jnp.asarray(rows["pins"]))
    poses = posenet.unscale_outputs(outputs, targets)
    predicted = {name: np.asarray(values) for name, values in poses.items()}
    errors = compute_pose_errors(predicted, read_true_values(targets, rows))
    return {name: float(np.mean(error)) for name, error in errors.items()}


def _widen(results: Results, errors: Mapping[str, float]) -> FullTable:
    """Widen the half-widths of all kinds by how much more PoseNet errs on the new taps."""
    before = results.pose_mae["tap"]
    factors = {name: max(1.0, error / (before[name] or error)) for name, error in errors.items()}
    widened = {}
    for kind, widths in (results.half_width or {}).items():
        widened[kind] = {name: width * factors.get(name, 1.0) for name, width in widths.items()}
    return widened
