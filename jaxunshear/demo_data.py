"""Write a small labelled recording of the simulator, in the folders that recordings have.

>>> write_demo_data(Path("demo"), contacts=300, seed=0)  # demo/331_pins/edge/tap/targets.csv, ...

Users without recordings can try `doctor`, `show`, `fit` and the other commands on it.
"""

import tempfile
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.data import MAX_SEED
from jaxunshear.config.sensor import (
    FITTED_CAMERA,
    FITTED_FRICTION,
    GEL_PAD,
    PAD_CAMERA,
    TACTIP_127,
    TACTIP_331_FITTED,
    Camera,
    Nuisance,
    Preprocess,
    Sensor,
)
from jaxunshear.data.labels import MOVE_COLUMNS, POSE_COLUMNS
from jaxunshear.errors import Note, UserError
from jaxunshear.files import Json, format_csv, write_bytes, write_text
from jaxunshear.output_checks import check_new_folder
from jaxunshear.perception.drawing import encode_png
from jaxunshear.perception.preprocess import binarise
from jaxunshear.progress import Counter, Progress, Stage
from jaxunshear.simulator.camera import render_frame
from jaxunshear.simulator.dome import count_dome_steps, load_dome
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import make_scenes
from jaxunshear.simulator.simulate import simulate

CONTACTS = 300  # taps, and as many slides, of 331 pins
MIN_CONTACTS = 30  # with fewer a split of `fit` may be empty
FEWER = 5  # times fewer contacts of other sensors
UNTOUCHED = 20  # frames
CAMERA_FRAMES = 40
STIMULUS = "edge"
ACROSS_MM = -5.0, 5.0  # of the poses; angles are over the full circle
TWIST_DEG = 5.0  # slides turn by up to this
RENDERED_AT_ONCE = 16
# of the progress, by time: to solve a contact is one step
HARMONIC_STEPS, RENDER_STEPS = 4.0, 0.5  # for a harmonic of a dome, and to render a contact
CAMERA_PX = 480  # side of grey frames as a camera gives them


class DemoSensor(NamedTuple):
    """A sensor, its camera, its folder, and its contacts."""

    name: str
    sensor: Sensor
    camera: Camera
    depth_mm: tuple[float, float] = (2.0, 4.5)
    slide_mm: float = 3.0  # slides move by up to this


SENSORS = (
    DemoSensor("331_pins", TACTIP_331_FITTED, FITTED_CAMERA),
    DemoSensor("127_pins", TACTIP_127, Camera()),
    DemoSensor("165_markers", GEL_PAD, PAD_CAMERA, (0.4, 1.2), 1.5),
)


class Labels(NamedTuple):
    """Poses and moves (N, 6) of contacts: x y z mm, Rx Ry Rz deg in the frame of the labels."""

    pose: np.ndarray
    move: np.ndarray

    def take(self, rows: np.ndarray) -> "Labels":
        return Labels(self.pose[rows], self.move[rows])


def write_demo_data(folder: Path, contacts: int = CONTACTS, seed: int = 0) -> None:
    """Write taps, slides, untouched frames and grey frames of the camera, for each of SENSORS.

    `contacts` is the number of taps, and of slides to their poses, of the first; others have fewer.
    The same seed gives the same bits. Raises UserError if the folder is not empty, or a number
    cannot be.
    """
    check_new_folder(folder, "DIR")
    if folder.is_dir() and any(folder.iterdir()):
        raise UserError(f"{folder} is not empty: name a new folder")
    if contacts < MIN_CONTACTS:
        raise UserError(f"--contacts {contacts}: use {MIN_CONTACTS} or more, so that `fit` can run")
    if not 0 <= seed <= MAX_SEED:
        raise UserError(f"--seed {seed}: use 0 to {MAX_SEED}")
    fewer = max(MIN_CONTACTS, contacts // FEWER)
    counts = contacts, *[fewer] * (len(SENSORS) - 1)
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as place:
        part = Path(place) / folder.name
        steps = 2 * sum(counts) * (1 + RENDER_STEPS)
        steps += HARMONIC_STEPS * sum(count_dome_steps(demo.sensor) for demo in SENSORS)
        with Progress("simulate", steps, unit="steps") as progress:
            for demo, count in zip(SENSORS, counts, strict=True):
                _write_sensor(part / demo.name, demo, count, seed, progress)
        part.rename(folder)  # one that is empty is replaced


def _write_sensor(folder: Path, demo: DemoSensor, count: int, seed: int, progress: Counter) -> None:
    load_dome(demo.sensor, Stage(progress, HARMONIC_STEPS))
    labels = sample_labels(demo, count, seed)
    pose, move = convert_labels(labels)
    scenes = make_scenes((STIMULUS,), np.zeros(2 * count, int), pose, move, FITTED_FRICTION)
    touched = simulate(demo.sensor, (STIMULUS,), scenes, progress=progress)
    untouched = np.repeat(compute_pin_tips(demo.sensor)[None], UNTOUCHED, axis=0)
    tips = np.concatenate([touched.pins, untouched])
    images = _render(demo, tips, seed, partial(binarise, Preprocess()))
    rows = np.flatnonzero(touched.converged)
    if failed := len(touched.converged) - len(rows):
        note = f"{demo.name}: contacts left out, as they did not converge: {failed}"
        warnings.warn(note, Note, stacklevel=2)
    taps, slides = rows[rows < count], rows[rows >= count]
    places = [(folder / STIMULUS / "tap", taps), (folder / STIMULUS / "shear", slides)]
    for place, selected in places:
        write_recording(place, images[selected], labels.take(selected), selected % count)
    shown = slides[:CAMERA_FRAMES]
    large = demo._replace(camera=replace(demo.camera, frame_px=CAMERA_PX))
    pictures = _render(large, touched.pins[shown], seed, _convert_to_bytes)
    write_recording(folder / "camera", pictures, labels.take(shown), shown - count)
    write_images(folder / "untouched", images[2 * count :])
    progress.advance(RENDER_STEPS * 2 * count)


def sample_labels(demo: DemoSensor, count: int, seed: int) -> Labels:
    """Sample `count` taps at random poses of an edge, then a slide to each of these poses."""
    generator = np.random.default_rng(seed)
    pose, move = np.zeros((2 * count, 6)), np.zeros((2 * count, 6))
    columns = {1: ACROSS_MM, 2: demo.depth_mm, 5: (-180.0, 180.0)}
    for column, limits in columns.items():
        pose[:, column] = np.tile(generator.uniform(*limits, count), 2)
    move[count:, :2] = generator.uniform(-demo.slide_mm, demo.slide_mm, (count, 2))
    move[count:, 5] = generator.uniform(-TWIST_DEG, TWIST_DEG, count)
    return Labels(np.round(pose, 6), np.round(move, 6))


def convert_labels(labels: Labels) -> tuple[np.ndarray, np.ndarray]:
    """Convert labels to poses (N, 4) and moves (N, 3) of scenes, as `calibration/labels.py` does.

    Their depth axis points into the object, and they turn the other way round.
    """
    x, y, turn = labels.move[:, 0], labels.move[:, 1], labels.move[:, 5]
    pose = np.stack([labels.pose[:, 1], labels.pose[:, 0], -labels.pose[:, 5], labels.pose[:, 2]])
    return pose.T, np.stack([y, x, -turn], axis=-1)


def _render(
    demo: DemoSensor, tips: np.ndarray, seed: int, convert: Callable[[Array], Array]
) -> np.ndarray:
    """Render pin tips (N, P, 3) mm as frames, which `convert` makes images of, one at a time."""

    def render(contact: tuple[Array, Array]) -> Array:
        tip, number = contact
        key = jax.random.fold_in(jax.random.key(seed), number)
        return convert(render_frame(demo.camera, demo.sensor, Nuisance(), tip, key))

    contacts = np.asarray(tips, np.float32), np.arange(len(tips))
    render_all = partial(jax.lax.map, render, batch_size=RENDERED_AT_ONCE)
    return np.asarray(jax.jit(render_all)(contacts))


def _convert_to_bytes(frame: Array) -> Array:
    return jnp.round(255 * frame).astype(jnp.uint8)


def write_recording(
    folder: Path, images: Iterable[np.ndarray], labels: Labels, pose_ids: np.ndarray
) -> None:
    """Write a recording in the older of the layouts that are read: `images/`, `targets.csv`."""
    rows: list[Json] = []
    for i, name in enumerate(write_images(folder / "images", images)):
        numbers = dict(zip(POSE_COLUMNS[0], labels.pose[i].tolist(), strict=True))
        numbers |= zip(MOVE_COLUMNS[0], labels.move[i].tolist(), strict=True)
        rows.append({"sensor_image": name, "pose_id": pose_ids[i], **numbers})
    write_text(folder / "targets.csv", format_csv(rows))


def write_images(folder: Path, images: Iterable[np.ndarray]) -> list[str]:
    """Write `image_1.png` and so on, and return their names."""
    names = []
    for number, image in enumerate(images, 1):
        names.append(f"image_{number}.png")
        write_bytes(folder / names[-1], encode_png(image))
    return names
