"""Score reconstructions from codes that are swapped, blanked, or of another image.

    results = ablate(experiment, Path("runs/demo"), Path("datasets"), command)

This is the ablation study of the paper's appendix D, extended. A cell is a decoder, the codes that
it is given, and the image that it should reconstruct. "Another image" is the one half the test
split further on.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import DISENTANGLED, UnshearNet
from jaxunshear.data.reader import Reader, concatenate_batches
from jaxunshear.errors import UserError
from jaxunshear.evaluation.intervals import INTERVALS_OVER, compute_intervals
from jaxunshear.evaluation.measurements import PAPER
from jaxunshear.evaluation.score import CELLS, get_cell_target, score_cells
from jaxunshear.files import Json, write_json
from jaxunshear.metrics import count_scales, format_ms_ssim_name
from jaxunshear.models.modality import IMAGES
from jaxunshear.models.registry import decode_canonical, decode_sheared, encode
from jaxunshear.models.weights import Net, Variables
from jaxunshear.progress import Progress
from jaxunshear.results.provenance import describe_provenance, read_training_facts
from jaxunshear.selection import number_poses
from jaxunshear.text_table import format_text_table
from jaxunshear.training.checkpoint import load_network
from jaxunshear.training.examples import open_examples
from jaxunshear.training.provenance import check_origin

# Codes of DC, or of DS' pose and shear slots: z_p, z_s; 0: blank; *: of another image
SWAP_CELLS: dict[str, tuple[str, ...]] = {
    "DC(z_p)": ("p",),
    "DC(z_s)": ("s",),
    "DS(z_p,z_s)": ("p", "s"),
    "DS(z_p,z_p)": ("p", "p"),
    "DS(z_p,0)": ("p", "0s"),
    "DS(0,z_s)": ("0p", "s"),
    "DS(z_p,z_s of another)": ("p", "*s"),
}
BATCH = 32
SEED = 0


def decode_cells(
    net: Net,
    variables: Variables,
    sheared: Array,
    names: Iterable[str] = CELLS,
    other: Array | None = None,
) -> dict[str, Array]:
    """Decode images (B, S, S, 1) in [0, 1], or pins px, of the named cells from codes of `sheared`.

    Codes of another contact are those of `other`. Cells that the network cannot decode are left
    out: without a shear code there is only DC's pose code, and a code in the other's place needs
    codes of one width.
    """
    own = encode(net, variables, sheared)
    foreign = own if other is None else encode(net, variables, other)
    z_p, z_s = own

    def get_code(name: str) -> Array | None:
        z = (foreign if name[0] == "*" else own)["ps".index(name[-1])]
        return jnp.zeros_like(z) if z is not None and name[0] == "0" else z

    decoded = {}
    for cell in names:
        codes = [get_code(name) for name in SWAP_CELLS[cell]]
        if codes[0] is None or codes[0].shape != z_p.shape:
            continue
        if len(codes) == 1:
            decoded[cell] = decode_canonical(net, variables, codes[0])
        elif z_s is not None and codes[1] is not None and codes[1].shape == z_s.shape:
            decoded[cell] = decode_sheared(net, variables, codes[0], codes[1])
    return decoded


def ablate(experiment: Experiment, run_dir: Path, data_dir: Path, command: str) -> Json:
    """Score all cells of the disentangled network in `run_dir`; write ablation.json there.

    The contacts are those of the test split. Raises `UserError` if the network or the data set is
    missing or damaged, or the network is entangled, learnt from other data or is not trained to the
    end.
    """
    net, variables = _load_network(Path(run_dir) / DISENTANGLED)
    check_origin(experiment, DISENTANGLED, run_dir)
    pairs = open_examples(experiment, DISENTANGLED, data_dir, run_dir).reader
    total = pairs.length("test")
    poses = number_poses(**pairs.take("test", np.arange(total), ("stimulus", "pose_id")))
    results = {
        "experiment": experiment.name,
        "simulated": experiment.paired.is_simulated,
        "metric": {"ms_ssim": format_ms_ssim_name(count_scales(net.size))},
        "rows": build_rows(_score_test_split(net, variables, pairs), poses),
        "contacts": total,
        "seed": SEED,
        **read_training_facts(run_dir, experiment.networks),
        **describe_provenance(command),
    }
    write_json(Path(run_dir) / "ablation.json", results)
    return results


def _load_network(folder: Path) -> tuple[UnshearNet, Variables]:
    """Load a disentangled network over images with its DS. Raises UserError for any other."""
    net, variables, _ = load_network(folder)
    if not isinstance(net, UnshearNet) or not net.disentangled:
        raise UserError(
            f"{folder} holds no disentangled network over images: there are no codes to swap; "
            "of a network over pins the table is in results.json"
        )
    if net.shear_channels and "DS" not in variables["params"]:
        raise UserError(
            f"{folder} holds released weights, which leave out DS: "
            "name the folder of a finished run"
        )
    return net, variables


def _score_test_split(
    net: UnshearNet, variables: Variables, pairs: Reader
) -> dict[str, np.ndarray]:
    @jax.jit
    def run(tap: Array, sheared: Array, other: Array) -> dict[str, Array]:
        tap, sheared, other = IMAGES.scale(tap), IMAGES.scale(sheared), IMAGES.scale(other)
        decoded = decode_cells(net, variables, sheared, SWAP_CELLS, other)
        return score_cells(decoded, {"tap": tap, "sheared": sheared}, other)

    total = pairs.length("test")
    parts: list[dict[str, np.ndarray]] = []
    with Progress("ablate", total) as progress:
        for start in range(0, total, BATCH):
            rows = np.arange(start, start + BATCH)  # all batches have one size
            batch = pairs.take("test", rows % total, ("canonical", "sheared"))
            other = pairs.take("test", (rows + total // 2) % total, ("sheared",))
            scores = run(batch["canonical"], batch["sheared"], other["sheared"])
            parts.append(jax.device_get(scores))
            progress.advance(min(BATCH, total - start))
    return {name: score[:total] for name, score in concatenate_batches(parts).items()}


def build_rows(scores: Mapping[str, np.ndarray], poses: np.ndarray) -> list[Json]:
    """Build a row for each cell: means, intervals over poses (N,), and the paper's figures."""
    intervals = compute_intervals(scores, poses, SEED)
    rows: dict[str, Json] = {}
    for name, values in scores.items():
        _, cell, metric = name.split("/")
        target = {"target": get_cell_target(cell), "paper": PAPER["swap"].get(cell)}
        row = rows.setdefault(cell, {"name": cell, **target})
        row[metric] = float(np.mean(values, dtype=np.float64))
        row[f"{metric} interval"] = intervals[name]
    return [rows[cell] for cell in SWAP_CELLS if cell in rows]


def format_table(rows: list[Json]) -> str:
    """Format a table for people; the paper's figures, of a real sensor, have their own column.

    The paper's figures are multi-scale, so ours are, too, with as many scales as fit the images.
    """
    lines = []
    for row in rows:
        line = {
            "cell": row["name"],
            "should draw": row["target"],
            "MSE": f"{row['mse']:.4f}",
            "MS-SSIM [95 %]": "{:.3f} [{:.3f}, {:.3f}]".format(
                row["ms_ssim"], *row["ms_ssim interval"]
            ),
            "to the other": row.get("ms_ssim to the other"),
            "paper: MSE, MS-SSIM": row["paper"] and "{mse}, {ms_ssim}".format(**row["paper"]),
        }
        lines.append(line)
    table = format_text_table(lines, tuple(lines[0]))
    return f"{table}\nbrackets: 95 % intervals over {INTERVALS_OVER}"
