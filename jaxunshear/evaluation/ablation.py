"""What each decoder makes of codes that are swapped, blanked, shuffled, or another image's: appendix D, and more of it.

    results = ablate(experiment, Path("runs/demo"), Path("datasets"), command)

A cell is a decoder, the codes it is fed, and the image it ought to draw; a code that the decoder does not use can be spoilt
without harm. "Another image" is one half the test split further on or, where that one lies at the same pose, the next
after it at another; only a split of a single pose has none there.
"""

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.errors import UserError
from jaxunshear.evaluation.cells import SPOILT, draw_cells
from jaxunshear.evaluation.paper import PAPER
from jaxunshear.evaluation.score import CELL_METRICS, cell_metrics, target_of
from jaxunshear.evaluation.spread import OVER, intervals, numbered_poses
from jaxunshear.evenly import evenly
from jaxunshear.metrics import ms_ssim_name, scales_that_fit
from jaxunshear.metrics.machine import provenance
from jaxunshear.progress import Progress
from jaxunshear.results.trained import read_trained
from jaxunshear.settings.experiment import Experiment, over_pins, recorded_of
from jaxunshear.settings.networks import UnshearNet
from jaxunshear.settings.registry import DISENTANGLED
from jaxunshear.storage import Json, write_bytes, write_json
from jaxunshear.style import png_of
from jaxunshear.training.checkpoint import check_finished, load_best, read_net
from jaxunshear.training.examples import open_examples
from jaxunshear.training.origin import check_origin

BATCH = 32
FIELDS = ("canonical", "sheared")
SHOWN = 6  # contacts in the picture
SEED = 0


def cell_scores(drawn: dict[str, Array], tap: Array, sheared: Array) -> dict[str, Array]:
    """`<cell>/<metric>` against the cell's target, and `<cell>/<metric> to the other` where a code of another image went in."""
    images = {"tap": tap, "sheared": sheared}
    metrics = cell_metrics(tap.shape[1])
    scores = {}
    for cell, image in drawn.items():
        target = images[target_of(cell)]
        for metric in CELL_METRICS:
            scores[f"{cell}/{metric}"] = metrics[metric](image, target)
            if "another" in cell:
                scores[f"{cell}/{metric} to the other"] = metrics[metric](
                    image, jnp.roll(target, len(tap) // 2, axis=0)
                )
    return scores


def ablate(experiment: Experiment, run_dir: Path, data_dir: Path, command: str) -> Json:
    """Scores all cells of the disentangled network in `run_dir` on the test split; writes ablation.json and ablation.png there.

    Raises `UserError` where the network or the data set is missing or damaged, or the network is entangled, learnt from
    other data or is not trained to the end.
    """
    folder = Path(run_dir) / DISENTANGLED
    if over_pins(experiment):
        raise UserError(
            f"{run_dir} reads pins: its table of swapped codes is in results.json; ablate a run over images"
        )
    check_finished(folder)
    net = read_net(folder)
    if not isinstance(net, UnshearNet) or not net.disentangled:
        raise UserError(f"{folder} holds no disentangled network: there are no codes to swap")
    variables = load_best(folder)
    if net.shear_channels and "DS" not in variables["params"]:
        raise UserError(f"{folder} holds released weights, which leave out DS: name the folder of a finished run")
    check_origin(experiment, DISENTANGLED, run_dir)
    pairs = open_examples(experiment, DISENTANGLED, data_dir, run_dir).reader
    total = pairs.length("test")
    labels = pairs.take("test", np.arange(total), ("stimulus", "pose_id"))
    poses = numbered_poses(**labels)

    @jax.jit
    def run(tap: Array, sheared: Array, key: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        tap, sheared = (images.astype(np.float32) / 255 for images in (tap, sheared))
        drawn = draw_cells(net, variables, sheared, SPOILT, key)
        return drawn, cell_scores(drawn, tap, sheared)

    found: list[dict[str, np.ndarray]] = []
    order: list[np.ndarray] = []
    shown: dict[str, np.ndarray] = {}
    with Progress("ablate", total) as progress:
        for number, (rows, counts) in enumerate(partners(poses, BATCH)):
            key = jax.random.fold_in(jax.random.key(SEED), number)
            batch = pairs.take("test", rows, FIELDS)
            drawn, scores = jax.device_get(run(batch["canonical"], batch["sheared"], key))
            found.append({name: value[counts] for name, value in scores.items()})
            order.append(rows[counts])
            if not shown and counts.any():
                shown = _shown(batch, drawn, np.flatnonzero(counts))
            progress.advance(int(counts.sum()))
    scores = {name: np.concatenate([part[name] for part in found]) for name in found[0]}
    results = {
        "experiment": experiment.name,
        "simulated": recorded_of(experiment) is None,
        "metric": {"ms_ssim": ms_ssim_name(scales_that_fit(net.size))},
        "rows": rows_of(scores, poses[np.concatenate(order)]),
        "contacts": total,
        "seed": SEED,
        **read_trained(run_dir, experiment.networks),
        **provenance(command),
    }
    write_bytes(Path(run_dir) / "ablation.png", picture(shown))
    write_json(Path(run_dir) / "ablation.json", results)
    return results


def _shown(batch: dict[str, np.ndarray], drawn: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Images (K, S, S) of some of the `rows` of a batch, SHOWN at most, for `picture`."""
    some = rows[evenly(len(rows), SHOWN)]
    shown = {name: batch[name][some, ..., 0] / 255 for name in ("sheared", "canonical")}
    return shown | {name: image[some, ..., 0] for name, image in drawn.items()}


def partners(poses: np.ndarray, batch: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Batches of rows of a split, partners half a batch apart; and which of them count. `poses` (N,): number of each row's.

    Partners lie half the split apart; where these are at one pose, each of them counts later, beside the next row at
    another. All batches are of one size, filled up by rows that have been there. Every row counts once.
    """
    total, half = len(poses), (len(poses) + 1) // 2
    width = min(max(1, batch // 2), half)
    first = np.arange(half)
    second = (first + half) % total
    apart = (poses[first] != poses[second]) | (len(np.unique(poses)) == 1)
    own = first + half < total  # of an odd number, one row is the partner of two
    again = np.concatenate([first[~apart], second[~apart & own]])
    others = np.array([_next_elsewhere(poses, row, half) for row in again], int)
    none, every = np.zeros(len(again), bool), np.ones(len(again), bool)
    for left, right, left_counts, right_counts in ((first, second, apart, apart & own), (again, others, every, none)):
        for start in range(0, len(left), width):
            place = np.arange(start, start + width)
            here, new = place % len(left), place < len(left)
            yield (
                np.concatenate([left[here], right[here]]),
                np.concatenate([left_counts[here] & new, right_counts[here] & new]),
            )


def _next_elsewhere(poses: np.ndarray, row: int, far: int) -> int:
    """The first of the rows from `far` beyond `row` on, around the end, that is at another pose."""
    rows = (row + far + np.arange(len(poses))) % len(poses)
    return int(rows[np.argmax(poses[rows] != poses[row])])


def rows_of(scores: dict[str, np.ndarray], poses: np.ndarray) -> list[Json]:
    """A row a cell: means with 95 % bootstrap intervals over poses (N,), and the paper's figures where it has them."""
    bands = intervals(scores, poses, SEED)
    rows = []
    for cell in SPOILT:
        names = [name for name in scores if name.startswith(f"{cell}/")]
        if not names:
            continue
        row: Json = {"name": cell, "target": target_of(cell), "paper": PAPER["swap"].get(cell)}
        for name in names:
            metric = name.removeprefix(f"{cell}/")
            row[metric] = float(np.mean(scores[name], dtype=np.float64))
            row[f"{metric} interval"] = bands[name]
        rows.append(row)
    return rows


def table(rows: list[Json]) -> str:
    """Make a table for people, with the paper's figures, of a real sensor, in a column of their own.

    The paper's figures are multi-scale, so ours are, too; as many scales as the images carry.
    """
    width = max(len(row["name"]) for row in rows)
    lines = [f"{'':{width}}  should draw  MSE     MS-SSIM [95 %]         to the other  paper: MSE, MS-SSIM"]
    for row in rows:
        low, high = row["ms_ssim interval"]
        other = f"{row['ms_ssim to the other']:.3f}" if "ms_ssim to the other" in row else ""
        paper = "{mse}, {ms_ssim}".format(**row["paper"]) if row["paper"] else ""
        lines.append(
            f"{row['name']:{width}}  {row['target']:11}  {row['mse']:.4f}  "
            f"{row['ms_ssim']:.3f} [{low:.3f}, {high:.3f}]  {other:12}  {paper}"
        )
    return "\n".join([*lines, f"brackets: 95 % intervals over {OVER}"])


def picture(shown: dict[str, np.ndarray]) -> bytes:
    """PNG: a row a cell, a column a contact; the images (K, S, S) in [0, 1] by name."""
    from matplotlib.figure import Figure

    count = len(next(iter(shown.values())))
    figure = Figure(figsize=(1.2 * count + 2.4, 1.2 * len(shown)), layout="constrained", dpi=90)
    panels = figure.subplots(len(shown), count, squeeze=False)
    for row, (name, images) in zip(panels, shown.items(), strict=True):
        for axes, image in zip(row, images, strict=True):
            axes.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
        row[0].set_ylabel({"canonical": "tap"}.get(name, name), rotation=0, ha="right", va="center", fontsize=8)
    return png_of(figure)
