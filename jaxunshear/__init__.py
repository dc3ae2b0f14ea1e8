"""A soft tactile dome in simulation, and networks that take the slide out of its images.

The packages are the steps of the data: simulator -> perception -> data -> models -> training ->
evaluation -> report. Every step can be imported and used by itself. `load_model` loads a trained
model; nothing is imported before it is called, so the command line starts quickly.
"""

from __future__ import annotations

import typing

from jaxunshear.version import __version__ as __version__

if typing.TYPE_CHECKING:
    from pathlib import Path

    from jaxunshear.inference.trained_model import TrainedModel


def load_model(
    name: str | Path, like: str | Path | None = None, force: bool = False
) -> TrainedModel:
    """Load a trained model: see `jaxunshear.api.load_model`."""
    from jaxunshear.inference.trained_model import load_model

    return load_model(name, like, force)
