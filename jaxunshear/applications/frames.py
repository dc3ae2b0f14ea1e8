"""Frames of a folder, checked to be of the sensor that a model learnt from."""

from collections.abc import Iterator

import numpy as np

from jaxunshear.applications.perceiver import Perceiver
from jaxunshear.dataset.recordings import Recordings, read_image
from jaxunshear.errors import UserError
from jaxunshear.image.preprocess import prepare_frame
from jaxunshear.image.understood import ENOUGH, inverse, plausibility, verdict

SAMPLED = 20  # frames that a folder is judged by


class Understood:
    """Frames of a folder that are of the model's sensor. Raises UserError where they are not, unless `force`d."""

    def __init__(self, recordings: Recordings, network: Perceiver, force: bool) -> None:
        self._recordings, self._network, self._force = recordings, network, force
        self._turned = False
        if force:
            return
        found = verdict(np.stack(list(self._sample())), network.expected)
        self._turned = found.inverted
        if found.inverted:
            recordings.notes.append(f"{found.reason}: they are turned")
        elif not found.ok:
            raise UserError(f"{recordings.path}: {found.reason}; --force answers all the same")

    def _sample(self) -> Iterator[np.ndarray]:
        """Up to SAMPLED frames, evenly spaced."""
        files, problem, some = self._recordings.files, "", False
        for file in files[:: -(-len(files) // SAMPLED)]:
            view = self._network.view or self._recordings.common_view(file.parent)
            try:
                yield prepare_frame(self._network.preprocess, read_image(file), view)
                some = True
            except UserError as error:
                problem = f"{file.name}: {error}"
        if not some:
            raise UserError(f"none of the sampled images in {self._recordings.path} can be read; the last: {problem}")

    def frames(self) -> Iterator[tuple[int, str, np.ndarray]]:
        """(row, name, image) of each frame that is understood; the others are left out and noted."""
        some = False
        for row, name, image in self._recordings.frames(self._network.view):
            image = inverse(image) if self._turned else image
            if not self._force and not self._turned and plausibility(image, self._network.expected) < ENOUGH:
                self._recordings.notes.append(f"left out {name}: its pins are not those of the model's sensor")
                continue
            some = True
            yield row, name, image
        if not some:
            raise UserError(
                f"{self._recordings.path}: no image is one of the model's sensor; --force answers all the same"
            )
