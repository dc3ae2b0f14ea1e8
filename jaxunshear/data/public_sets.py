"""Check a download of public recordings against its frozen split, and list its rows.

>>> checked = check_public_set("edge_2d", Path("recordings/edge_2d"))
>>> checked.rows[0]  # {"kind": "tap", "name": "image_1.png", "split": "train"}
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import Recorded, SplitMethod
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.frozen_splits import compute_image_checksum, read_frozen_splits
from jaxunshear.data.recorded_contacts import KINDS, read_contacts, select_labels
from jaxunshear.files import Json


class CheckedKind(NamedTuple):
    """The taps, or the slides, of a download."""

    counts: Mapping[str, int]  # contacts by split
    has_same_images: bool  # as the public set, in black and white


class CheckedSet(NamedTuple):
    """A download that has the labels of the public set."""

    rows: list[Json]  # kind, name and split of each contact
    kinds: Mapping[str, CheckedKind]  # by "tap" and "slide"


def check_public_set(name: SplitMethod, folder: Path) -> CheckedSet:
    """Compare the labels and the images of a download with the public set `name`.

    Raises UserError if the labels differ, or an image cannot be read.
    """
    place = str(folder)
    contacts = read_contacts(Recorded(tap_folder=place, slide_folder=place, split=name))
    frozen = read_frozen_splits()[name]
    rows: list[Json] = []
    kinds: dict[str, CheckedKind] = {}
    for is_slide, kind in KINDS.items():
        chosen = np.flatnonzero(contacts.is_slide == is_slide)
        if not len(chosen):
            continue
        labels, split = select_labels(contacts, is_slide), contacts.split[chosen]
        for image, index in zip(labels.names, split, strict=True):
            rows.append({"kind": kind, "name": image, "split": SPLITS[index]})
        checksum = compute_image_checksum(labels, [contacts.files[row] for row in chosen])
        counts = {each: int(np.sum(split == i)) for i, each in enumerate(SPLITS)}
        kinds[kind] = CheckedKind(counts, checksum == frozen[kind]["images"])
    return CheckedSet(rows, kinds)
