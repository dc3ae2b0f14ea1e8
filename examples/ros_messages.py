"""Images of ROS 2 as arrays, and bags without ROS. Needs numpy alone."""

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np

CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "8UC3": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
IMAGE = "sensor_msgs/msg/Image"


class BagFrame(NamedTuple):
    time_s: float  # when the picture was taken, by its header
    pixels: np.ndarray  # (H, W) or (H, W, 3) uint8, red, green, blue


def to_pixels(encoding: str, shape: tuple[int, int], step: int, data: bytes) -> np.ndarray:
    """Turn an Image's fields into pixels; `shape` is its height and width, `step` bytes per row."""
    if encoding not in CHANNELS:
        raise SystemExit(f"an image of encoding {encoding}: use one of {', '.join(CHANNELS)}")
    height, width = shape
    channels = CHANNELS[encoding]
    rows = np.frombuffer(data, np.uint8, height * step).reshape(height, step)
    pixels = rows[:, : width * channels].reshape(height, width, channels)
    if channels == 1:
        return pixels[..., 0]
    return pixels[..., 2::-1] if encoding.startswith("bgr") else pixels[..., :3]


def read_bag(bag: Path, topic: str) -> Iterator[BagFrame]:
    """Yield the images of a topic in a bag of SQLite: a folder, or its file that ends in .db3."""
    files = sorted(bag.glob("*.db3"), key=lambda file: (len(file.name), file.name))
    files = files if bag.is_dir() else [bag]
    if not files or any(file.suffix != ".db3" for file in files):
        raise SystemExit(
            f"{bag} holds no .db3: `ros2 bag convert` makes one of an MCAP (storage_id: sqlite3)"
        )
    for file in files:
        with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as database:
            topics = dict(database.execute("SELECT name, type FROM topics").fetchall())
            if topics.get(topic) != IMAGE:
                images = sorted(name for name, kind in topics.items() if kind == IMAGE)
                raise SystemExit(f"{file} has no images on {topic}: name one of {images}")
            rows = database.execute(
                "SELECT data FROM messages JOIN topics ON topic_id = topics.id WHERE name = ? "
                "ORDER BY timestamp",
                (topic,),
            )
            for (message,) in rows:
                yield decode_image(message)


def decode_image(message: bytes) -> BagFrame:
    """Decode an Image as DDS writes it (CDR): four bytes of form, then fields at their own size."""
    order = "<" if message[1] & 1 else ">"
    place = 4

    def take(kind: str) -> int:
        nonlocal place
        size = struct.calcsize(kind)
        place += -(place - 4) % size
        (value,) = struct.unpack_from(order + kind, message, place)
        place += size
        return value

    def take_bytes() -> bytes:
        nonlocal place
        length = take("I")
        place += length
        return message[place - length : place]

    seconds, nanoseconds = take("i"), take("I")
    take_bytes()  # frame_id
    shape = take("I"), take("I")
    encoding = take_bytes().rstrip(b"\0").decode()
    take("B")  # is_bigendian: bytes have no order
    step = take("I")
    return BagFrame(seconds + nanoseconds / 1e9, to_pixels(encoding, shape, step, take_bytes()))
