"""Make recordings in the published layouts, in milliseconds.

Pins move as smooth functions of pose and slide, and are drawn as dots. No contact is solved: what
matters is that pose and slide can be read off the pins, and that files lie where a laboratory's do.
"""

from pathlib import Path

import jax
import numpy as np
from PIL import Image

from jaxunshear.config.sensor import TACTIP_127, Sensor
from jaxunshear.data.labels import MOVE_COLUMNS, POSE_COLUMNS
from jaxunshear.demo_data import Labels, write_recording
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.simulator.pin_layout import compute_pin_lattice

SIZE = 96
DOTS = jax.jit(draw_dots, static_argnums=(1, 2))
OLDER = [*POSE_COLUMNS[0], *MOVE_COLUMNS[0]]
NEWER = [*POSE_COLUMNS[1], *MOVE_COLUMNS[1]]


def rest_px(sensor: Sensor = TACTIP_127, size: int = SIZE) -> np.ndarray:
    """(P, 2) px, the untouched pins."""
    flat = compute_pin_lattice(sensor)
    return (size - 1) / 2 + 0.375 * size * flat / np.linalg.norm(flat, axis=-1).max()


def pins_px(
    pose: np.ndarray, move: np.ndarray, sensor: Sensor = TACTIP_127, size: int = SIZE
) -> np.ndarray:
    """Return the pins (P, 2) px of a contact.

    An edge at y, deep by z, turned by Rz, spreads the pins on its side; a slide drags those in
    touch.
    """
    rest = rest_px(sensor, size)
    unit = (rest - (size - 1) / 2) / (0.375 * size)
    angle = np.radians(pose[5])
    normal = np.array([np.cos(angle), np.sin(angle)])
    inside = 1 / (1 + np.exp(-6 * (unit @ normal - pose[1] / 6)))
    touch = inside * np.exp(-3 * (unit**2).sum(-1)) * pose[2]
    spread = 0.012 * size * touch[:, None] * (unit + 0.5 * normal)
    return rest + spread + 0.006 * size * touch[:, None] * move[:2]


def contacts(count: int, slid: bool, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses and moves (N, 6): y, z and Rz vary; sorted by angle, as published rows are."""
    rng = np.random.default_rng(seed)
    pose, move = np.zeros((count, 6)), np.zeros((count, 6))
    pose[:, 1], pose[:, 2] = rng.uniform(-3, 3, count), rng.uniform(3, 5, count)
    pose[:, 5] = np.sort(rng.uniform(-180, 180, count))
    if slid:
        move[:, :2] = rng.uniform(-3, 3, (count, 2))
    return np.round(pose, 6), np.round(move, 6)


def write(
    folder: Path,
    pose: np.ndarray,
    move: np.ndarray,
    layout: str = "older",
    sensor: Sensor = TACTIP_127,
    pose_id: np.ndarray | None = None,
    size: int = SIZE,
) -> Path:
    """A folder of one recording. Returns it."""
    pins = np.stack([pins_px(*each, sensor, size) for each in zip(pose, move, strict=True)])
    radius = 0.017 * size * (127 / sensor.pins) ** 0.5
    images = [draw(each, radius, size) for each in pins]
    ids = np.arange(1, len(pose) + 1) if pose_id is None else pose_id
    write_recording(folder, images, Labels(pose, move), ids)
    if layout == "newer":
        (folder / "images").rename(folder / "processed_images")
        heading, rows = (folder / "targets.csv").read_text().split("\n", 1)
        for before, after in zip(OLDER, NEWER, strict=True):
            heading = heading.replace(before, after)
        (folder / "targets.csv").write_text(f"{heading}\n{rows}")
    return folder


def draw(pins: np.ndarray, radius: float, size: int) -> np.ndarray:
    """An image (S, S) uint8 of {0, 255}."""
    return (255 * np.asarray(DOTS(pins[None].astype(np.float32), radius, size))[0, ..., 0]).astype(
        np.uint8
    )


def hide_pins(folder: Path, numbers: list[int]) -> None:
    """Paint out the pins in the middle, a sixth of all, in images of the older layout.

    A few lost pins would be no reason to refuse an image: the pins around them agree.
    """
    for number in numbers:
        file = folder / "images" / f"image_{number}.png"
        picture = np.array(Image.open(file))
        row, column = (side // 2 for side in picture.shape)
        picture[row - 12 : row + 12, column - 12 : column + 12] = 0
        Image.fromarray(picture).save(file)


def edge(
    folder: Path, taps: int = 60, slides: int = 60, seed: int = 0, layout: str = "older"
) -> Path:
    """Taps and slides of an edge, in two folders below one."""
    write(folder / "tap" / "csv_train", *contacts(taps, False, seed), layout)
    write(folder / "shear" / "csv_train", *contacts(slides, True, seed + 1), layout)
    return folder


def surface(folder: Path, taps: int = 60, slides: int = 60, seed: int = 0) -> Path:
    """Taps and slides on a surface, of which depth alone varies."""
    for name, count, slid in (("tap", taps, False), ("shear", slides, True)):
        pose, move = contacts(count, slid, seed + slid)
        pose[:, 1], pose[:, 5] = 3.0, 0.0
        if count:
            write(folder / name / "csv_train", pose, move)
    return folder
