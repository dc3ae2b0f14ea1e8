"""Finds the folder of a model by its path or by the name of released weights."""

import os
from collections.abc import Sequence
from pathlib import Path

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.serialization import from_json
from jaxunshear.errors import UserError
from jaxunshear.files import read_object

RELEASED = Path(__file__).parent / "weights"  # a folder for each name, with a model card


def find_model_folder(model: Path) -> Path:
    """Return the folder of the released weights of this name; any other path as it is."""
    is_name = len(model.parts) == 1 and not model.exists()
    released = RELEASED / model
    return released if is_name and (released / "experiment.json").is_file() else model


def load_settings(model: Path) -> Experiment:
    """Load the experiment that a folder was made with. Raises UserError."""
    file = model / "experiment.json"
    if not file.is_file():
        names = ", ".join(sorted(folder.name for folder in RELEASED.glob("*") if folder.is_dir()))
        raise UserError(
            f"{model} holds no experiment.json: name the folder of a finished run, "
            f"such as runs/demo, or released weights{f' ({names})' if names else ''}"
        )
    return from_json(read_object(file), str(file))


def make_distinct_names(folders: Sequence[Path]) -> list[str]:
    """Return the folders' names, or as much of the ends of their paths as distinguishes them."""
    parts = [Path(os.path.abspath(folder)).parts for folder in folders]
    for count in range(1, max(map(len, parts))):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [str(folder) for folder in folders]
