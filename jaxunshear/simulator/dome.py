"""The condensed dome or pad of a sensor: computed once (about 10 s), then cached on disk.

A cache file is a checksum, the harmonics of the compliance (7 MB), and the settings they belong to.
A damaged file is reported and made again. Two processes at the same work each put a complete file
in place.
"""

import contextlib
import hashlib
import io
import json
import os
import re
import sys
import uuid
import zipfile
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np

from jaxunshear.config.contact_rings import RING_MM, compute_ring_arcs, compute_ring_spacing
from jaxunshear.config.sensor import Pad, Sensor, check_sensor, describe_sensor
from jaxunshear.errors import UserError
from jaxunshear.files import cache_folder
from jaxunshear.progress import Counter, Progress
from jaxunshear.simulator.elasticity import (
    Compliance,
    HarmonicResponse,
    Pins,
    compute_isotropic_stiffness,
    compute_response,
    sum_harmonics,
)
from jaxunshear.simulator.mesh import make_dome_mesh, make_pad_mesh
from jaxunshear.simulator.pin_layout import compute_pin_levers, compute_pin_tips

VERSION = 5  # of what a cache file means: raise it with every change of the model
MESH_MM = 1.0  # of elements, where rings are RING_MM apart
_BROKEN = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


@lru_cache(maxsize=4)
def load_shared_dome(sensor: Sensor) -> Compliance:
    """Load the sensor's dome and keep it in memory."""
    return load_dome(sensor)


def load_dome(sensor: Sensor, progress: Counter | None = None) -> Compliance:
    """Load the compliance of a sensor's contact nodes and pins, or compute and cache it.

    Computing it advances `progress` by `count_dome_steps`; without one it shows a bar of its own.
    """
    return sum_harmonics(_load_response(sensor, varied=False, progress=progress))


def count_dome_steps(sensor: Sensor) -> int:
    """Count the steps in which `load_dome` computes: 0 if the dome is in the cache."""
    path, _ = _name_file(sensor, varied=False)
    return 0 if path.is_file() else _count_harmonics(sensor) + 1


def load_sensitivity(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Load the derivatives of w (3N, 3N) and g (3P, 3N) by log(skin_modulus_mpa), cached too.

    By log(gel_modulus_mpa) they are -w and -g less these: both moduli together only scale.
    """
    slopes = sum_harmonics(_load_response(sensor, varied=True))
    return slopes.w, slopes.g


def compute_dome(sensor: Sensor) -> Compliance:
    """Compute what `load_dome` loads. Raises `UserError` for a sensor that cannot be."""
    return sum_harmonics(_compute(sensor, varied=False))


def _mesh_mm(sensor: Sensor) -> float:
    return MESH_MM * compute_ring_spacing(sensor) / RING_MM


def _compute(sensor: Sensor, varied: bool, progress: Counter | None = None) -> HarmonicResponse:
    check_sensor(sensor)
    if isinstance(sensor, Pad):
        size = sensor.pad_radius_mm, sensor.pad_mm
        mesh = make_pad_mesh(*size, sensor.skin_mm, _mesh_mm(sensor))
    else:
        mesh = make_dome_mesh(sensor.dome_radius_mm, sensor.skin_mm, _mesh_mm(sensor))
    gel = compute_isotropic_stiffness(sensor.gel_modulus_mpa, sensor.gel_poisson)
    skin = compute_isotropic_stiffness(sensor.skin_modulus_mpa, sensor.skin_poisson)
    materials = np.where(mesh.skin[:, None, None], skin, gel)
    arcs = compute_ring_arcs(sensor)
    hats = np.append(arcs, arcs[-1] + compute_ring_spacing(sensor))
    pins = Pins(compute_pin_tips(sensor), compute_pin_levers(sensor))
    harmonics = _count_harmonics(sensor)
    elements = mesh.skin if varied else None
    return compute_response(mesh, materials, hats, pins, harmonics, elements, progress)


def _count_harmonics(sensor: Sensor) -> int:
    """Count the nodes in the outer ring; the other rings bear fewer harmonics."""
    return 6 * (len(compute_ring_arcs(sensor)) - 1)


def _name_file(sensor: Sensor, varied: bool) -> tuple[Path, str]:
    """Name the cache file of a sensor, and the settings that it belongs to."""
    check_sensor(sensor)
    settings = {
        **describe_sensor(sensor),
        "version": VERSION,
        "mesh": _mesh_mm(sensor),
        "rings": compute_ring_arcs(sensor).tolist(),
        "harmonics": _count_harmonics(sensor),
        "varied": varied,
    }
    text = json.dumps(settings, sort_keys=True)
    name = re.sub(r"[^A-Za-z0-9._-]", "_", sensor.name)[:40]
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return cache_folder() / f"dome-{name}-{digest}.bin", text


def _load_response(
    sensor: Sensor, varied: bool, progress: Counter | None = None
) -> HarmonicResponse:
    path, text = _name_file(sensor, varied)
    try:
        return _read(path, text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except _BROKEN as error:
        print(f"the cache file {path} is of no use ({error}): it is made again", file=sys.stderr)
    return _make_file(path, text, sensor, varied, progress)


def _make_file(
    path: Path, settings: str, sensor: Sensor, varied: bool, progress: Counter | None
) -> HarmonicResponse:
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.touch()  # before the work: a folder that cannot be written to is reported at once
        steps = _count_harmonics(sensor) + 1
        own = Progress(f"dome of {sensor.name}", steps, unit="harmonics")
        with own if progress is None else contextlib.nullcontext(progress) as counter:
            response = _compute(sensor, varied, counter)
        stream = io.BytesIO()
        np.savez(stream, settings=np.array(settings), **asdict(response))
        data = stream.getvalue()
        part.write_bytes(hashlib.sha256(data).digest() + data)
        os.replace(part, path)
    except OSError as error:
        raise UserError(
            f"cannot write the cache file {path}: {error.strerror}; "
            "set JAXUNSHEAR_CACHE to a folder with room"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # the first error is the one worth reporting
            part.unlink(missing_ok=True)
    return response


def _read(path: Path, settings: str) -> HarmonicResponse:
    """Read a cache file.

    Raises one of _BROKEN if it does not hold what belongs to the settings.
    """
    data = path.read_bytes()
    if hashlib.sha256(data[32:]).digest() != data[:32]:
        raise ValueError("damaged: its checksum does not agree")
    with np.load(io.BytesIO(data[32:])) as stored:
        if str(stored["settings"]) != settings:
            raise ValueError("made with other settings")
        return HarmonicResponse(**{name: stored[name] for name in stored if name != "settings"})
