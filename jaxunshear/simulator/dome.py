"""The condensed dome of a sensor: computed once (about 10 s), then cached on disk.

A cache file is a checksum, the harmonics of the compliance (7 MB), and the settings they belong to.
A file that does not hold what it should is reported and made again. Two processes at the same work
each put a complete file in place.
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
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from jaxunshear.config.reach import RING_MM, compute_ring_arcs, compute_ring_spacing
from jaxunshear.config.sensor import Sensor, check_sensor
from jaxunshear.errors import UserError
from jaxunshear.files import cache_folder
from jaxunshear.progress import Progress
from jaxunshear.simulator.elasticity import (
    Compliance,
    HarmonicResponse,
    Pins,
    compute_isotropic_stiffness,
    compute_response,
    sum_harmonics,
)
from jaxunshear.simulator.mesh import make_dome_mesh
from jaxunshear.simulator.pin_layout import compute_pin_levers, compute_pin_tips

VERSION = 5  # of what a cache file means: raise it with every change of the model
MESH_MM = 1.0  # of elements, where rings are RING_MM apart
_BROKEN = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


def load_dome(sensor: Sensor) -> Compliance:
    """Load the compliance of a sensor's contact nodes and pins, or compute and cache it."""
    return sum_harmonics(_load_response(sensor, varied=False))


def load_sensitivity(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Load the derivatives of w (3N, 3N) and g (3P, 3N) by log(skin_modulus_mpa), cached too.

    By log(gel_modulus_mpa) they are -w and -g less these: both moduli together only scale.
    """
    slopes = sum_harmonics(_load_response(sensor, varied=True))
    return slopes.w, slopes.g


def compute_dome(sensor: Sensor) -> Compliance:
    """Compute what `load_dome` loads. Raises `UserError` for a sensor that cannot be."""
    return sum_harmonics(_compute(sensor, modulus_derivative=False))


def _mesh_mm(sensor: Sensor) -> float:
    return MESH_MM * compute_ring_spacing(sensor) / RING_MM


def _compute(
    sensor: Sensor, modulus_derivative: bool, progress: Progress | None = None
) -> HarmonicResponse:
    check_sensor(sensor)
    mesh = make_dome_mesh(sensor.dome_radius_mm, sensor.skin_mm, _mesh_mm(sensor))
    gel = compute_isotropic_stiffness(sensor.gel_modulus_mpa, sensor.gel_poisson)
    skin = compute_isotropic_stiffness(sensor.skin_modulus_mpa, sensor.skin_poisson)
    materials = np.where(mesh.skin[:, None, None], skin, gel)
    arcs = compute_ring_arcs(sensor)
    hats = np.append(arcs, arcs[-1] + compute_ring_spacing(sensor))
    pins = Pins(compute_pin_tips(sensor), compute_pin_levers(sensor))
    varied = mesh.skin if modulus_derivative else None
    return compute_response(mesh, materials, hats, pins, _count_harmonics(sensor), varied, progress)


def _count_harmonics(sensor: Sensor) -> int:
    """Count the nodes in the outer ring; the other rings bear fewer harmonics."""
    return 6 * (len(compute_ring_arcs(sensor)) - 1)


def _load_response(sensor: Sensor, varied: bool) -> HarmonicResponse:
    check_sensor(sensor)
    settings = {
        **asdict(sensor),
        "version": VERSION,
        "mesh": _mesh_mm(sensor),
        "rings": compute_ring_arcs(sensor).tolist(),
        "harmonics": _count_harmonics(sensor),
        "varied": varied,
    }
    text = json.dumps(settings, sort_keys=True)
    name = re.sub(r"[^A-Za-z0-9._-]", "_", sensor.name)[:40]
    path = cache_folder() / f"dome-{name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.bin"
    try:
        return _read(path, text, sensor)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except _BROKEN as error:
        print(f"the cache file {path} is of no use ({error}): it is made again", file=sys.stderr)
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.touch()  # before the work: a folder that cannot be written to is reported at once
        with Progress(
            f"dome of {sensor.name}", _count_harmonics(sensor) + 1, unit="harmonics"
        ) as progress:
            response = _compute(sensor, varied, progress)
        part.write_bytes(_pack_response(response, text))
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


def _pack_response(response: HarmonicResponse, settings: str) -> bytes:
    stream = io.BytesIO()
    np.savez(
        stream,
        settings=np.array(settings),
        **{field.name: getattr(response, field.name) for field in fields(response)},
    )
    return hashlib.sha256(stream.getvalue()).digest() + stream.getvalue()


def _read(path: Path, settings: str, sensor: Sensor) -> HarmonicResponse:
    """Read a cache file.

    Raises one of _BROKEN if it does not hold what belongs to the settings.
    """
    data = path.read_bytes()
    if hashlib.sha256(data[32:]).digest() != data[:32]:
        raise ValueError("damaged: its checksum does not agree")
    with np.load(io.BytesIO(data[32:])) as stored:
        response = HarmonicResponse(
            **{field.name: stored[field.name] for field in fields(HarmonicResponse)}
        )
        if str(stored["settings"]) != settings:
            raise ValueError("made with other settings")
    rings, harmonics = len(compute_ring_arcs(sensor)), _count_harmonics(sensor) + 1
    places = int(response.positions.max(initial=0)) + 1
    shapes = {
        "nodes": (1 + 3 * rings * (rings - 1), 3),
        "pins": (sensor.pins, 3),
        "positions": (sensor.pins,),
        "rings": (harmonics, 3 * rings, 3 * rings),
        "fields": (harmonics, 3 * places, 3 * rings),
    }
    for name, shape in shapes.items():
        values = getattr(response, name)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"its {name} are not {shape} finite numbers")
    return response
