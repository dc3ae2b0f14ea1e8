"""Score reconstructions from codes that are swapped, blanked, or of another image.

    results = ablate(experiment, Path("runs/demo"), Path("datasets"), command)

This is the ablation study of the paper's appendix D, extended. A cell is a decoder, the codes that
it is given, and the image that it should reconstruct. "Another image" is the one half the test
split further on.
"""

from pathlib import Path

import jax
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.networks import UnshearNet
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.data.reader import Reader
from jaxunshear.errors import UserError
from jaxunshear.evaluation.bootstrap import INTERVALS_OVER, compute_intervals, number_poses
from jaxunshear.evaluation.code_swaps import SWAP_CELLS, decode_cells
from jaxunshear.evaluation.paper_results import PAPER
from jaxunshear.evaluation.score import CELL_METRICS, get_cell_target, make_cell_metrics
from jaxunshear.evaluation.score_collection import concatenate_batches
from jaxunshear.files import Json, write_json
from jaxunshear.metrics import count_scales, format_ms_ssim_name
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.models.weights import Variables
from jaxunshear.progress import Progress
from jaxunshear.results.training_summaries import read_training_facts
from jaxunshear.training.checkpoint import check_finished, load_best, read_net
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.examples import open_examples

BATCH = 32
FIELDS = ("canonical", "sheared")
SEED = 0


def score_cells(
    decoded: dict[str, Array], tap: Array, sheared: Array, other: Array
) -> dict[str, Array]:
    """Score images against each cell's target, and against `other` if it gave a code.

    All images are (B, S, S, 1). Scores (B,) are named `<cell>/<metric>` and
    `<cell>/<metric> to the other`.
    """
    targets = {"tap": tap, "sheared": sheared}
    metrics = make_cell_metrics(tap.shape[1])
    scores = {}
    for cell, image in decoded.items():
        for metric in CELL_METRICS:
            scores[f"{cell}/{metric}"] = metrics[metric](image, targets[get_cell_target(cell)])
            if "another" in cell:
                scores[f"{cell}/{metric} to the other"] = metrics[metric](image, other)
    return scores


def ablate(experiment: Experiment, run_dir: Path, data_dir: Path, command: str) -> Json:
    """Score all cells of the disentangled network in `run_dir`; write ablation.json there.

    The contacts are those of the test split. Raises `UserError` if the network or the data set is
    missing or damaged, or the network is entangled, learnt from other data or is not trained to the
    end.
    """
    if uses_pins(experiment):
        raise UserError(
            f"{run_dir} reads pins: its table of swapped codes is in results.json; "
            "ablate a run over images"
        )
    net, variables = _load_network(Path(run_dir) / DISENTANGLED)
    check_origin(experiment, DISENTANGLED, run_dir)
    pairs = open_examples(experiment, DISENTANGLED, data_dir, run_dir).reader
    total = pairs.length("test")
    labels = pairs.take("test", np.arange(total), ("stimulus", "pose_id"))
    poses = number_poses(**labels)
    scores = _score_test_split(net, variables, pairs)
    results = {
        "experiment": experiment.name,
        "simulated": experiment.paired.is_simulated,
        "metric": {"ms_ssim": format_ms_ssim_name(count_scales(net.size))},
        "rows": build_rows(scores, poses),
        "contacts": total,
        "seed": SEED,
        **read_training_facts(run_dir, experiment.networks),
        **describe_provenance(command),
    }
    write_json(Path(run_dir) / "ablation.json", results)
    return results


def _load_network(folder: Path) -> tuple[UnshearNet, Variables]:
    """Load a disentangled network over images with its DS. Raises UserError for any other."""
    check_finished(folder)
    net = read_net(folder)
    if not isinstance(net, UnshearNet) or not net.disentangled:
        raise UserError(f"{folder} holds no disentangled network: there are no codes to swap")
    variables = load_best(folder)
    if net.shear_channels and "DS" not in variables["params"]:
        raise UserError(
            f"{folder} holds released weights, which leave out DS: "
            "name the folder of a finished run"
        )
    return net, variables


def _score_test_split(
    net: UnshearNet, variables: Variables, pairs: Reader
) -> dict[str, np.ndarray]:
    """Score all cells on all contacts of the test split: (N,) by name."""

    @jax.jit
    def run(tap: Array, sheared: Array, other: Array) -> dict[str, Array]:
        tap = tap.astype(np.float32) / 255
        sheared = sheared.astype(np.float32) / 255
        other = other.astype(np.float32) / 255
        decoded = decode_cells(net, variables, sheared, SWAP_CELLS, other)
        return score_cells(decoded, tap, sheared, other)

    total = pairs.length("test")
    parts: list[dict[str, np.ndarray]] = []
    with Progress("ablate", total) as progress:
        for start in range(0, total, BATCH):
            rows = np.arange(start, start + BATCH)  # all batches have one size
            batch = pairs.take("test", rows % total, FIELDS)
            other = pairs.take("test", (rows + total // 2) % total, FIELDS)
            scores = run(batch["canonical"], batch["sheared"], other["sheared"])
            parts.append(jax.device_get(scores))
            progress.advance(min(BATCH, total - start))
    return {name: score[:total] for name, score in concatenate_batches(parts).items()}


def build_rows(scores: dict[str, np.ndarray], poses: np.ndarray) -> list[Json]:
    """Build a row for each cell: means, intervals over poses (N,), and the paper's figures."""
    intervals = compute_intervals(scores, poses, SEED)
    rows = []
    for cell in SWAP_CELLS:
        names = [name for name in scores if name.startswith(f"{cell}/")]
        if not names:
            continue
        row: Json = {
            "name": cell,
            "target": get_cell_target(cell),
            "paper": PAPER["swap"].get(cell),
        }
        for name in names:
            metric = name.removeprefix(f"{cell}/")
            row[metric] = float(np.mean(scores[name], dtype=np.float64))
            row[f"{metric} interval"] = intervals[name]
        rows.append(row)
    return rows


def format_table(rows: list[Json]) -> str:
    """Format a table for people; the paper's figures, of a real sensor, have their own column.

    The paper's figures are multi-scale, so ours are, too, with as many scales as fit the images.
    """
    width = max(len(row["name"]) for row in rows)
    lines = [
        f"{'':{width}}  should draw  MSE     MS-SSIM [95 %]         to the other  "
        "paper: MSE, MS-SSIM"
    ]
    for row in rows:
        low, high = row["ms_ssim interval"]
        other = f"{row['ms_ssim to the other']:.3f}" if "ms_ssim to the other" in row else ""
        paper = "{mse}, {ms_ssim}".format(**row["paper"]) if row["paper"] else ""
        lines.append(
            f"{row['name']:{width}}  {row['target']:11}  {row['mse']:.4f}  "
            f"{row['ms_ssim']:.3f} [{low:.3f}, {high:.3f}]  {other:12}  {paper}"
        )
    return "\n".join([*lines, f"brackets: 95 % intervals over {INTERVALS_OVER}"])
