"""Simulate contacts and render their images, in one file a batch, so that a killed run continues.

Files are written by the process that asked for them, wherever the contacts were made. What disturbs
an image depends on the seed and the contact's number alone, neither on the chunk nor on what was
done before.
"""

import functools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax import Array

from jaxunshear.cluster import Call, CallRunner, WorkerDied, run_locally
from jaxunshear.config.configs import compute_config_name
from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.sensor import LAYOUTS, Camera, LayoutFunction, Nuisance, Preprocess, Sensor
from jaxunshear.data.sampling import ContactSamples
from jaxunshear.errors import UserError
from jaxunshear.files import BROKEN_NPZ, read_npz, write_npz
from jaxunshear.perception.png import encode_png
from jaxunshear.progress import Progress
from jaxunshear.simulator.contact_results import Contacts
from jaxunshear.simulator.scene import Scenes

PNG_LEVEL = 4
STORED_FIELDS = {  # of a chunk: the field of `Contacts` that it holds
    "residual_mm": "residual_mm",
    "iterations": "iterations",
    "stuck": "stuck_nodes",
    "slipping": "slipping_nodes",
    "free": "free_nodes",
}
RENDER_BATCH = 16  # images rendered at once: one shape to compile, little memory

Chunk = dict[str, np.ndarray]


class SimulationEngine(NamedTuple):
    """What makes contacts and images; the tests put fast stand-ins here."""

    plan: Callable[..., list[np.ndarray]]  # (sensor, names, scenes) -> index batches
    simulate: Callable[..., Any]  # (sensor, names, scenes) -> Contacts
    # (settings, sensor, tips, number, age) -> images, pins in px
    render: Callable[..., tuple[np.ndarray, np.ndarray]]
    run_calls: CallRunner = run_locally  # who makes the chunks


def make_engine(run_calls: CallRunner = run_locally) -> SimulationEngine:
    """Make the engine that simulates and renders."""
    from jaxunshear.simulator import simulate

    return SimulationEngine(simulate.plan, simulate.simulate, render_images, run_calls)


def simulate_chunks(
    settings: PairedData | PoseData,
    sensor: Sensor,
    samples: ContactSamples,
    folder: Path,
    engine: SimulationEngine,
) -> list[Path]:
    """Simulate all contacts into one file per batch of `engine.plan`; files that exist are kept.

    A contact that did not converge, even when the simulator tried it again, or whose image is
    black, is stored as not usable. A chunk holds `number`, `usable`, `retried` (n,), `images`
    (n, bytes) at one bit a pixel, `pins` (n, P, 2) px, and what the solver reports of each contact.
    """
    scenes = samples.scenes
    batches = engine.plan(sensor, settings.stimuli, scenes)
    paths = [folder / f"{index:05d}.npz" for index in range(len(batches))]
    missing = {
        path: batch for path, batch in zip(paths, batches, strict=True) if not _holds(path, batch)
    }
    calls = (
        Call(
            path,
            _simulate_chunk,
            (
                settings,
                sensor,
                LAYOUTS[sensor.layout],
                scenes.take(batch),
                np.asarray(batch),
                samples.age[batch],
                engine,
            ),
        )
        for path, batch in missing.items()
    )
    label = f"simulate {settings.set_name}/{compute_config_name(settings, sensor)}"
    done = len(scenes) - sum(map(len, missing.values()))
    with Progress(label, len(scenes), unit="contacts", done=done) as progress:
        for path, chunk in engine.run_calls(calls):
            if isinstance(chunk, WorkerDied):
                raise UserError(
                    f"chunk {path.name}: {chunk.reason}; fewer at once (--ray-cores) "
                    "have more memory each; then run the same command"
                )
            write_npz(path, chunk)
            progress.advance(len(missing[path]))
    return paths


def _holds(path: Path, batch: np.ndarray) -> bool:
    """Return whether a killed run left this very batch; another version may have planned others."""
    return path.exists() and np.array_equal(load_chunk(path)["number"], batch)


def _simulate_chunk(
    settings: PairedData | PoseData,
    sensor: Sensor,
    layout: LayoutFunction,
    scenes: Scenes,
    number: np.ndarray,
    age: np.ndarray,
    engine: SimulationEngine,
) -> Chunk:
    """Simulate the contacts `number` (n,), which touch at `scenes` and `age`.

    A machine of a cluster needs no more than these arguments.
    """
    LAYOUTS[sensor.layout] = layout  # a cluster's machine has not read the experiment file
    contacts = engine.simulate(sensor, settings.stimuli, scenes)
    fields = {name: np.array(getattr(contacts, field)) for name, field in STORED_FIELDS.items()}
    usable, tips = _is_usable(contacts), np.array(contacts.pins)
    size = settings.preprocess.size
    images = np.zeros((len(number), -(-size * size // 8)), np.uint8)
    pins = np.zeros((*tips.shape[:2], 2), np.float32)
    if usable.any():
        rendered, rendered_pins = engine.render(
            settings, sensor, tips[usable], number[usable], age[usable]
        )
        images[usable] = pack_bits(rendered)
        pins[usable] = rendered_pins
        usable &= images.any(axis=-1)  # a frame that is not finite comes out black
    return {
        "number": number,
        "usable": usable,
        "retried": np.asarray(contacts.retried),
        "images": images,
        "pins": pins,
        **fields,
    }


def _is_usable(contacts: Contacts) -> np.ndarray:
    finite = np.isfinite(contacts.pins).all((1, 2)) & np.isfinite(contacts.residual_mm)
    return finite & np.asarray(contacts.converged, bool)


def load_chunk(path: Path) -> Chunk:
    """Load a chunk's fields. Raises UserError for a damaged file."""
    try:
        return read_npz(path)
    except BROKEN_NPZ as error:
        raise UserError(
            f"chunk {path} cannot be read ({error}): delete it and run the same command again"
        ) from error


def write_chunks(
    folder: Path, parts: list[np.ndarray], make: Callable[[list[int]], Iterable[Chunk]], label: str
) -> list[Path]:
    """Write a file for each part, rows of contacts; files that exist are kept, returns all.

    `make` yields the chunks of the parts of these numbers, in order.
    """
    paths = [folder / f"{index:05d}.npz" for index in range(len(parts))]
    missing = [index for index, path in enumerate(paths) if not path.exists()]
    if not missing:
        return paths
    count = sum(map(len, parts))
    done = count - sum(len(parts[index]) for index in missing)
    with Progress(label, count, "contacts", done=done) as progress:
        for index, chunk in zip(missing, make(missing), strict=True):
            write_npz(paths[index], chunk)
            progress.advance(len(parts[index]))
    return paths


class ChunkRow(NamedTuple):
    """One contact in a chunk."""

    chunk: Chunk
    place: int  # in the chunk
    row: int  # among all contacts

    def encode_png(self, size: int) -> bytes:
        """Encode its image as sets store it."""
        return encode_png(unpack_bits(self.chunk["images"][self.place], size), PNG_LEVEL)

    def get(self, name: str) -> Any:
        """Return its value of a field."""
        return self.chunk[name][self.place]


def iterate_usable_rows(paths: Iterable[Path], selected: np.ndarray) -> Iterator[ChunkRow]:
    """Iterate over the usable contacts that are `selected` (N,) bool, in the order of the chunks.

    Raises UserError for a damaged chunk.
    """
    for path in paths:
        chunk = load_chunk(path)
        for place in np.flatnonzero(chunk["usable"] & selected[chunk["number"]]):
            yield ChunkRow(chunk, int(place), int(chunk["number"][place]))


def render_images(
    settings: PairedData | PoseData,
    sensor: Sensor,
    tips: np.ndarray,
    number: np.ndarray,
    age: np.ndarray,
    at_once: int = RENDER_BATCH,
) -> tuple[np.ndarray, np.ndarray]:
    """Render pin tips (B, P, 3) mm of the contacts `number` (B,).

    Batches are filled up to `at_once` images: set it lower where there are never more. Returns
    images (B, S, S) uint8 in {0, 255}, and the pins (B, P, 2) px in them.
    """
    images, pins = [], []
    render = _make_renderer(settings.camera, settings.nuisance, settings.preprocess, sensor)
    for start in range(0, len(tips), at_once):
        rows = np.arange(start, min(start + at_once, len(tips)))
        padded = np.resize(rows, at_once)
        image, image_pins = render(
            np.asarray(tips[padded], np.float32),
            np.uint32(settings.seed),
            np.asarray(number[padded], np.uint32),
            np.asarray(age[padded], np.float32),
        )
        images.append(np.asarray(image)[: len(rows)])
        pins.append(np.asarray(image_pins)[: len(rows)])
    return np.concatenate(images), np.concatenate(pins)


@functools.cache
def _make_renderer(
    camera: Camera, nuisance: Nuisance, preprocess: Preprocess, sensor: Sensor
) -> Callable[..., tuple[Array, Array]]:
    import jax

    from jaxunshear.perception.preprocess import binarise
    from jaxunshear.simulator import camera as cameras

    def render_one(tips: Array, seed: Array, number: Array, age: Array) -> Array:
        key = jax.random.fold_in(jax.random.key(seed), number)
        return cameras.render_frame(camera, sensor, nuisance, tips, key, age)

    @jax.jit
    def render(tips: Array, seed: Array, number: Array, age: Array) -> tuple[Array, Array]:
        frames = jax.vmap(render_one, in_axes=(0, None, 0, 0))(tips, seed, number, age)
        drift = cameras.compute_drift(nuisance, age)[:, None, :]
        position = cameras.project(camera, tips, sensor) + drift
        return binarise(preprocess, frames), cameras.to_image_px(camera, preprocess, position)

    return render


def pack_bits(images: np.ndarray) -> np.ndarray:
    """Pack binary images (B, S, S) to (B, bytes), one bit a pixel."""
    return np.packbits(images.reshape(len(images), -1) > 0, axis=-1)


def unpack_bits(bits: np.ndarray, size: int) -> np.ndarray:
    """Unpack (..., bytes) to images (..., S, S) uint8 in {0, 255}."""
    pixels = np.unpackbits(bits, axis=-1, count=size * size)
    return pixels.reshape(*bits.shape[:-1], size, size) * np.uint8(255)
