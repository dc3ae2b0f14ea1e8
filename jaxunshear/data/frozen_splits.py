"""Frozen splits: which contacts of public recordings are for training, validation and test.

>>> check_frozen_split("edge_2d", labels, split)  # raises UserError if they differ

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

from jaxunshear.config.splits import SPLITS
from jaxunshear.data.recordings import read_image
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.perception.grey import to_grey
from jaxunshear.progress import Progress

FILE = Path(__file__).with_name("frozen_splits.toml")
DIGITS = 16  # of a checksum
WHITE = 0.5  # of a grey image; brighter pixels are white


class ContactLabels(NamedTuple):
    """The labels of N contacts of one kind, "tap" or "slide"."""

    kind: str
    names: Sequence[str]  # of the images, without folders
    pose: np.ndarray  # (N, 6) mm, deg
    move: np.ndarray  # (N, 6) mm, deg


def read_frozen_splits() -> Json:
    """Read the frozen splits by the name of their set."""
    return tomllib.loads(FILE.read_text())


def check_frozen_split(name: str, labels: ContactLabels, split: np.ndarray) -> None:
    """Check that contacts, and their splits (N,) as indices into SPLITS, are as published.

    Raises UserError if the contacts differ from the set.
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
    if compute_row_checksum(labels, split) != frozen["rows"]:
        raise RuntimeError(f"the frozen split {name} is drawn in another way than it was")


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
