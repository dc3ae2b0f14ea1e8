"""Frozen splits: which contacts of public recordings are for training, validation and test.

>>> split = apply_frozen_split("edge_2d", labels)  # (N,) indices into SPLITS

`frozen_splits.toml` has, for the taps and for the slides of each set, checksums of the labels, of
the images and of the rows of each split. Recordings with other labels are refused, so scores on one
split are always of the same contacts. Checksums depend on values alone: labels count as float32,
and images as black and white, so files may be written in another way.
"""

import hashlib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.splits import SPLITS, hash_text
from jaxunshear.data.recorded_splits import TEST, TRAIN, VALIDATION, format_pose
from jaxunshear.data.recordings import read_image
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.perception.grey import to_grey
from jaxunshear.progress import Progress

FILE = Path(__file__).with_name("frozen_splits.toml")
DIGITS = 16  # of a checksum
WHITE = 0.5  # of a grey image; brighter pixels are white
KEPT_OUT = 0.1  # share of the poses for test, and for validation


class ContactLabels(NamedTuple):
    """The labels of N contacts of one kind, "tap" or "slide"."""

    kind: str
    names: Sequence[str]  # of the images, without folders
    pose: np.ndarray  # (N, 6) mm, deg
    move: np.ndarray  # (N, 6) mm, deg


def read_frozen_splits() -> Json:
    """Read the frozen splits by the name of their set."""
    return tomllib.loads(FILE.read_text())


def apply_frozen_split(name: str, labels: ContactLabels) -> np.ndarray:
    """Return the splits of contacts, (N,) indices into SPLITS, as the frozen split has them.

    Raises UserError if the contacts are not those of the set.
    """
    frozen, kind = read_frozen_splits()[name][labels.kind], labels.kind
    if len(labels.names) != frozen["contacts"]:
        raise UserError(
            f"split = {name}: must be used on the {frozen['contacts']} {kind}s of the public set, "
            f"not on {len(labels.names)}; name the folders that docs/benchmark.md lists"
        )
    if compute_label_checksum(labels) != frozen["labels"]:
        raise UserError(
            f"split = {name}: must be used on {kind}s with the names, poses and moves of the "
            "public set, and these differ; download the set again"
        )
    split = draw_rows(labels)
    if compute_row_checksum(labels, split) != frozen["rows"]:
        raise RuntimeError(f"the frozen split {name} is drawn in another way than it was")
    return split


def describe_frozen_split(labels: ContactLabels, files: Sequence[Path]) -> Json:
    """Describe the split of contacts, as `frozen_splits.toml` has it for a kind of contacts."""
    split = draw_rows(labels)
    counts = {name: int(np.sum(split == index)) for index, name in enumerate(SPLITS)}
    return {
        "contacts": len(labels.names),
        **counts,
        "labels": compute_label_checksum(labels),
        "images": compute_image_checksum(labels, files),
        "rows": compute_row_checksum(labels, split),
    }


def draw_rows(labels: ContactLabels) -> np.ndarray:
    """Draw the splits of contacts by their poses, as the split "random" of seed 0 does."""
    poses = labels.pose.astype(np.float32).astype(np.float64)
    keys = np.array([hash_text(f"0 {format_pose(pose)}") / 2**64 for pose in poses])
    held_out = np.where(keys < KEPT_OUT, TEST, VALIDATION)
    return np.where(keys < 2 * KEPT_OUT, held_out, TRAIN)


def compute_label_checksum(labels: ContactLabels) -> str:
    """Compute the checksum of names, poses and moves, in any order of the contacts."""
    digest = hashlib.sha256()
    numbers = np.concatenate([labels.pose, labels.move], axis=1).astype("<f4") + np.float32(0)
    for row in _sort(labels):
        digest.update(f"{labels.names[row]}\n".encode() + numbers[row].tobytes())
    return digest.hexdigest()[:DIGITS]


def compute_image_checksum(labels: ContactLabels, files: Sequence[Path]) -> str:
    """Compute the checksum of the images in black and white. Raises UserError."""
    digest = hashlib.sha256()
    with Progress(f"images of {labels.kind}s", len(files)) as progress:
        for row in _sort(labels):
            white = to_grey(read_image(files[row])) > WHITE
            digest.update(f"{labels.names[row]} {white.shape}\n".encode())
            digest.update(np.packbits(white).tobytes())
            progress.advance()
    return digest.hexdigest()[:DIGITS]


def compute_row_checksum(labels: ContactLabels, split: np.ndarray) -> str:
    """Compute the checksum of the split of each contact, by its name."""
    lines = [f"{labels.names[row]} {SPLITS[split[row]]}\n" for row in _sort(labels)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()[:DIGITS]


def _sort(labels: ContactLabels) -> list[int]:
    return sorted(range(len(labels.names)), key=lambda row: labels.names[row])
