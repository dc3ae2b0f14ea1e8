"""The condensed dome of a sensor, computed once (about 15 s) and kept in a cache folder."""

import hashlib
import json
import os
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from jaxunshear.contact.elasticity import Compliance, condense, isotropic
from jaxunshear.contact.mesh import dome_mesh
from jaxunshear.errors import UserError
from jaxunshear.progress import Progress
from jaxunshear.scene.sensor import Sensor, pin_tips

MESH_MM = 1.0
RING_MM = 1.0  # lateral distance of the contact rings
RINGS = 17
HARMONICS = 96


def cache_folder() -> Path:
    """$JAXUNSHEAR_CACHE, or jaxunshear/ in the user's cache folder."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("JAXUNSHEAR_CACHE") or Path(home) / "jaxunshear")


def reach_mm(sensor: Sensor, depth_mm: float) -> float:
    """Lateral reach of the undeformed dome below `depth_mm`."""
    return float(np.sqrt(max(2 * sensor.dome_radius_mm * depth_mm - depth_mm**2, 0.0)))


def deepest_mm(sensor: Sensor) -> float:
    """The depth beyond which the contact rings no longer cover the contact."""
    covered = (RINGS - 1) * RING_MM
    return sensor.dome_radius_mm - float(np.sqrt(sensor.dome_radius_mm**2 - covered**2))


def compute_dome(sensor: Sensor, mesh_mm: float = MESH_MM, harmonics: int = HARMONICS, progress=None) -> Compliance:
    """Compliance of the dome's contact nodes and pins; see `elasticity`."""
    mesh = dome_mesh(sensor.dome_radius_mm, sensor.skin_mm, mesh_mm)
    gel = isotropic(sensor.gel_modulus_mpa, sensor.gel_poisson)
    skin = isotropic(sensor.skin_modulus_mpa, sensor.skin_poisson)
    materials = np.where(mesh.skin[:, None, None], skin, gel)
    return condense(mesh, materials, np.arange(RINGS + 1) * RING_MM, pin_tips(sensor), harmonics, progress)


def dome(sensor: Sensor) -> Compliance:
    """`compute_dome`, from the cache where it is there and whole."""
    settings = {
        **asdict(sensor),
        "mesh": MESH_MM,
        "ring": RING_MM,
        "rings": RINGS,
        "harmonics": HARMONICS,
        "version": 1,
    }
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
    path = cache_folder() / f"dome-{sensor.name}-{key}.npz"
    try:
        with np.load(path) as stored:
            return Compliance(stored["nodes"], stored["pins"], stored["w"], stored["g"])
    except FileNotFoundError:
        pass
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        path.unlink(missing_ok=True)  # a damaged cache file is only a lost shortcut
    with Progress(f"dome of {sensor.name}", HARMONICS + 1, unit="harmonics") as progress:
        made = compute_dome(sensor, progress=progress)
    _store(path, made)
    return made


def _store(path: Path, made: Compliance) -> None:
    part = path.with_suffix(f".{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(part, "wb") as stream:
            np.savez(stream, nodes=made.nodes, pins=made.pins, w=made.w, g=made.g)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise UserError(
            f"cannot write the cache file {path}: {error.strerror}; set JAXUNSHEAR_CACHE to a folder with room"
        ) from error
