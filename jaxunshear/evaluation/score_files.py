"""Write the files with scores and images that an evaluation leaves in the folder of its run."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.evaluation.contact_scores import ContactScores
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.files import write_bytes
from jaxunshear.results.run import Results

SMOOTH = "smooth"  # label of contacts whose nearest edge has one direction
QUANTILES = (0.1, 0.5, 0.9)  # of the similarity of the contacts in a montage


class EvaluatedRun(NamedTuple):
    """The results of a run, and the scores that they come from."""

    results: Results
    scores: ContactScores | None
    further: Mapping[str, ContactScores]  # of further tests, by name
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


def encode_scores(contacts: ContactScores) -> bytes:
    """Encode all scores as npz, with the labels `stimulus`, `pose_id`, and SMOOTH if known.

    All are (N,) by name.
    """
    names = [name for name in ("stimulus", "pose_id", SMOOTH) if name in contacts.labels]
    labels = {name: contacts.labels[name] for name in names}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **contacts.scores, **labels)  # type: ignore[arg-type]
    return buffer.getvalue()


def encode_montage(names: tuple[str, ...], contacts: ContactScores) -> bytes:
    """Encode a few contacts as npz: of each stimulus one of low, middling and high similarity.

    The similarity is that of the unsheared image. Images (M, S, S) uint8 are by kind, `stimulus`
    (M,) are names, `pose` is (M, 4 or 6), `move` (M, 2 or 3), and `ms_ssim_<kind>` (M,).
    """
    stimulus = contacts.labels["stimulus"][contacts.kept_rows]
    main_kind = choose_main_kind(contacts.images)
    similarity = contacts.scores[f"ms_ssim/{main_kind}"][contacts.kept_rows]
    shown = select_typical(similarity, stimulus)
    rows = contacts.kept_rows[shown]
    arrays = {
        "stimulus": np.array(names)[stimulus[shown]],
        "pose": contacts.labels["pose"][rows],
        "move": contacts.labels["move"][rows],
    }
    for kind, images in contacts.images.items():
        arrays[kind] = images[shown]
        if kind != "tap":
            arrays[f"ms_ssim_{kind}"] = contacts.scores[f"ms_ssim/{kind}"][rows]
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def select_typical(scores: np.ndarray, stimulus: np.ndarray) -> np.ndarray:
    """Select contacts to show: for each stimulus those at QUANTILES of the score, worst first.

    Returns indices, none twice.
    """
    chosen: list[int] = []
    for index in np.unique(stimulus):
        inside = np.flatnonzero(stimulus == index)
        ranked = inside[np.argsort(scores[inside], kind="stable")]
        chosen += dict.fromkeys(int(ranked[round(q * (len(ranked) - 1))]) for q in QUANTILES)
    return np.array(chosen, np.int64)
