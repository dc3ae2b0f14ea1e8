"""Write the files with scores and images that an evaluation leaves in the folder of its run."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.evaluation.result_tables import select_typical
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.evaluation.score_collection import CollectedScores
from jaxunshear.evaluation.unambiguous_edges import SMOOTH
from jaxunshear.files import write_bytes
from jaxunshear.results.run import Results


class EvaluatedRun(NamedTuple):
    """The results of a run, and the scores that they come from."""

    results: Results
    scores: CollectedScores | None
    further: Mapping[str, CollectedScores]  # of further tests, by name
    montage_names: tuple[str, ...]  # names of the stimuli in the montage; none: no montage


def write_score_files(run_dir: Path, evaluated: EvaluatedRun) -> None:
    """Write `scores.npz`, `scores-<test>.npz` and `montage.npz`."""
    if evaluated.scores is not None:
        write_bytes(run_dir / "scores.npz", encode_scores(evaluated.scores))
        if evaluated.montage_names:
            montage = encode_montage(evaluated.montage_names, evaluated.scores)
            write_bytes(run_dir / "montage.npz", montage)
    for name, scores in evaluated.further.items():
        write_bytes(run_dir / f"scores-{name}.npz", encode_scores(scores))


def encode_scores(collected: CollectedScores) -> bytes:
    """Encode all scores as npz, with the labels `stimulus`, `pose_id`, and SMOOTH if known.

    All are (N,) by name.
    """
    names = [name for name in ("stimulus", "pose_id", SMOOTH) if name in collected.labels]
    labels = {name: collected.labels[name] for name in names}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **collected.scores, **labels)  # type: ignore[arg-type]
    return buffer.getvalue()


def encode_montage(names: tuple[str, ...], collected: CollectedScores) -> bytes:
    """Encode a few contacts as npz: of each stimulus one of low, middling and high similarity.

    The similarity is that of the unsheared image. Images (M, S, S) uint8 are by kind, `stimulus`
    (M,) are names, `pose` is (M, 4 or 6), `move` (M, 2 or 3), and `ms_ssim_<kind>` (M,).
    """
    stimulus = collected.labels["stimulus"][collected.kept_rows]
    main_kind = choose_main_kind(collected.images)
    similarity = collected.scores[f"ms_ssim/{main_kind}"][collected.kept_rows]
    shown = select_typical(similarity, stimulus)
    rows = collected.kept_rows[shown]
    arrays = {
        "stimulus": np.array(names)[stimulus[shown]],
        "pose": collected.labels["pose"][rows],
        "move": collected.labels["move"][rows],
    }
    for kind, images in collected.images.items():
        arrays[kind] = images[shown]
    for kind in collected.images:
        if kind != "tap":
            arrays[f"ms_ssim_{kind}"] = collected.scores[f"ms_ssim/{kind}"][rows]
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()
