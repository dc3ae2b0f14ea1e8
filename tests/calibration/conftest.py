"""A simulated recording, of which the true calibration is known."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image

from jaxunshear.calibration.fit import render_images
from jaxunshear.calibration.labels import EDGE_STIMULUS, make_paths, read_motions
from jaxunshear.config.sensor import Camera, Sensor
from jaxunshear.simulator.simulate import follow

# A small dome has few nodes and elements, and few pins are detected quickly.
SMALL = Sensor(
    name="small",
    rings=6,
    pin_spacing_mm=1.1,
    pin_radius_mm=0.3,
    pin_length_mm=0.5,
    dome_radius_mm=8.0,
    skin_mm=0.7,
    gel_modulus_mpa=0.1,
)
GUESS = Camera(frame_px=128, mm_across=12.6, distance_mm=80.0)  # where the fit starts
SURFACE_MM = 0.35


class Truth(NamedTuple):
    folder: Path
    sensor: Sensor
    camera: Camera
    friction: float


def write_recording(
    folder: Path, images: np.ndarray, poses: np.ndarray | None, moves: np.ndarray | None
) -> None:
    """Write the older layout: images/, targets.csv, meta.json."""
    (folder / "images").mkdir(parents=True)
    for i, image in enumerate(images):
        Image.fromarray(image).save(folder / "images" / f"image_{i + 1}.png")
    (folder / "meta.json").write_text("{}")
    if poses is None:
        return
    with open(folder / "targets.csv", "w", newline="") as stream:
        write = csv.writer(stream).writerow
        labels = {"pose": poses} if moves is None else {"pose": poses, "move": moves}
        names = [f"{kind}_{i}" for kind in labels for i in range(1, 7)]
        write(["sensor_image", *names])
        for i, row in enumerate(np.concatenate(list(labels.values()), axis=1)):
            write([f"image_{i + 1}.png", *row])


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """Record presses and slides on a flat top, with a tilt and a rotated camera.

    Sensor and camera differ from SMALL and GUESS.
    """
    sensor = replace(SMALL, pin_radius_mm=0.36)
    camera = replace(GUESS, mm_across=13.4, housing=1.2)  # the housing begins within the mask
    friction = 0.35
    rng = np.random.default_rng(0)
    count = 36
    poses, moves = np.zeros((count, 6)), np.zeros((count, 6))
    poses[:, 2] = SURFACE_MM + rng.uniform(0.5, 1.6, count)
    poses[:, 3:5] = rng.uniform(-6, 6, (count, 2))
    poses[:, 5] = rng.uniform(-60, 60, count)
    moves[6:, :2] = rng.uniform(-0.6, 0.6, (count - 6, 2))
    contacts = read_motions(poses, moves)
    solved, _ = follow(
        sensor, (EDGE_STIMULUS,), make_paths(contacts, sensor, SURFACE_MM, 0, friction)
    )
    assert solved.converged.all()
    images = render_images(camera, sensor, solved.pins, seed=1)
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder, np.ascontiguousarray(np.rot90(images, axes=(1, 2))), poses, moves)
    return Truth(folder, sensor, camera, friction)
