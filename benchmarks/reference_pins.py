"""Solves the contacts that errors are measured against, at a far stronger level.

They are kept in the cache folder. A stored answer is used only for the same scenes, sensor, level,
versions and source of the simulator.
"""

import hashlib
import json
from dataclasses import asdict
from importlib.resources import files

import numpy as np

from jaxunshear.config.sensor import Sensor
from jaxunshear.errors import UserError
from jaxunshear.files import BROKEN_NPZ, cache_folder, read_npz, write_npz
from jaxunshear.progress import Progress
from jaxunshear.results.provenance import list_versions
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.simulate import simulate


def solve_reference_pins(
    sensor: Sensor, names: tuple[str, ...], scenes: Scenes, level: Level
) -> np.ndarray:
    """Solve the pin tips (B, P, 3) mm of scenes.

    Raises UserError if a contact does not converge.
    """
    path = cache_folder() / f"pins-{_compute_digest(sensor, names, scenes, level)}.npz"
    try:
        pins = read_npz(path)["pins"]
        if pins.shape == (len(scenes), sensor.pins, 3) and np.isfinite(pins).all():
            return pins
    except BROKEN_NPZ:
        pass  # missing or damaged: solve again
    with Progress("reference", len(scenes), unit="contacts") as progress:
        contacts = simulate(sensor, names, scenes, level, retry=False, progress=progress)
    unsolved = np.flatnonzero(~contacts.converged)
    if len(unsolved):
        raise UserError(
            f"the reference does not converge for scenes {unsolved.tolist()}: "
            "no error can be measured against it"
        )
    write_npz(path, {"pins": contacts.pins})
    return contacts.pins


def _compute_digest(sensor: Sensor, names: tuple[str, ...], scenes: Scenes, level: Level) -> str:
    settings = [asdict(sensor), names, asdict(level), list_versions()]
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for field in (scenes.stimulus.astype(np.int64), scenes.pose, scenes.move, scenes.friction):
        digest.update(np.ascontiguousarray(field).tobytes())
    for source in sorted(files("jaxunshear.simulator").iterdir(), key=lambda file: file.name):
        if source.name.endswith(".py"):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
