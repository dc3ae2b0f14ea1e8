"""Estimate what the simulated data of an experiment cost, before anything of it is made.

>>> check_cost(experiment, Path("datasets"))
"""

import os
import shutil
import warnings
from pathlib import Path

from jaxunshear.config.configs import get_set_folder
from jaxunshear.config.data import PairedData, SimulatedData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.types import check_types
from jaxunshear.errors import Note, UserError

LABEL_BYTES = 200  # of a contact, beside its image and its pins
LONG_HOURS = 24
# On two cores, as experiments/demo.py does; images of 128 px
CONTACTS_PER_HOUR = 2e5
TRAINING_IMAGES_PER_HOUR = 4e5
GB = 1e9


def check_cost(experiment: Experiment, data: Path) -> None:
    """Refuse simulated sets that fit neither into memory nor onto the disk of the folder `data`.

    Warns with a `Note` of a run that may take more than LONG_HOURS. Raises UserError.
    """
    check_types(experiment)
    memory, disk, hours = 0.0, 0.0, 0.0
    trainings = {"paired": experiment.train, "pose": experiment.train_posenet}
    for name, training in trainings.items():
        settings = getattr(experiment, name)
        if not isinstance(settings, SimulatedData):
            continue
        contacts = _count_contacts(settings)
        set_bytes = contacts * _count_bytes(settings, experiment.sensor.pins)
        memory += set_bytes
        images = contacts * training.epochs * (settings.preprocess.size / 128) ** 2
        hours += images / TRAINING_IMAGES_PER_HOUR
        if not get_set_folder(settings, experiment.sensor, data).exists():
            disk += set_bytes
            hours += contacts / CONTACTS_PER_HOUR
    remedy = "use fewer --paired.poses and --pose.poses, or smaller images"
    _refuse(memory, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), "memory", remedy)
    _refuse(disk, _measure_free_disk(data), f"disk space at --data {data}", remedy)
    if hours > LONG_HOURS:
        text = f"this may take about {hours:,.0f} hours on two cores: use fewer epochs or poses"
        warnings.warn(text, Note, stacklevel=2)


def _count_contacts(settings: SimulatedData) -> int:
    a_pose = settings.taps + settings.slides if isinstance(settings, PairedData) else 1
    return len(settings.stimuli) * settings.poses * a_pose


def _count_bytes(settings: SimulatedData, pins: int) -> int:
    """Count the bytes of a contact: an image at a bit a pixel, pins, labels."""
    return settings.preprocess.size**2 // 8 + 8 * pins + LABEL_BYTES


def _measure_free_disk(folder: Path) -> int:
    folder = folder.absolute()
    return shutil.disk_usage(next(each for each in (folder, *folder.parents) if each.exists())).free


def _refuse(needed: float, available: float, what: str, remedy: str) -> None:
    if needed > available:
        raise UserError(
            f"this run needs about {needed / GB:,.0f} GB of {what}, "
            f"and there are {available / GB:,.0f} GB: {remedy}"
        )
