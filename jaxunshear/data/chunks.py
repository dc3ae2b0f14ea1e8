"""Scenes -> contacts -> images, in files of one batch each, so that a killed run goes on where it stopped.

Files are written by the process that asked for them, wherever the contacts were made. What disturbs an image depends on the seed
and the contact's number alone, neither on the chunk nor on what was done before.
"""

import functools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax import Array

from jaxunshear.cluster import Call, CallRunner, WorkerDied, run_locally
from jaxunshear.config.configs import compute_config_name, get_set_name
from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.image import Camera, Nuisance, Preprocess
from jaxunshear.config.sensor import Sensor
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


class SimulationEngine(NamedTuple):
    """What makes contacts and images; the tests put fast stand-ins here."""

    plan: Callable[..., list[np.ndarray]]  # (sensor, names, scenes) -> index batches
    simulate: Callable[..., Any]  # (sensor, names, scenes) -> Contacts
    render: Callable[
        ..., tuple[np.ndarray, np.ndarray]
    ]  # (settings, sensor, tips, number, age) -> images, pins in px
    run_calls: CallRunner = run_locally  # who makes the chunks


def make_engine(spread: CallRunner = run_locally) -> SimulationEngine:
    """The real one."""
    from jaxunshear.simulator import simulate

    return SimulationEngine(simulate.plan, simulate.simulate, render_images, spread)


def _usable(contacts: Contacts) -> np.ndarray:
    finite = np.isfinite(contacts.pins).all((1, 2)) & np.isfinite(contacts.residual_mm)
    return finite & np.asarray(contacts.converged, bool)


def simulate_chunks(
    settings: PairedData | PoseData,
    sensor: Sensor,
    samples: ContactSamples,
    folder: Path,
    engine: SimulationEngine,
) -> list[Path]:
    """Simulates all shots into one file per batch of `engine.plan`; files that are there already are kept.

    A contact that did not converge, not even where the simulator tried it again, or whose image is black, is stored as not
    usable. A chunk holds `number`, `usable`, `retried` (n,), `images` (n, bytes) at
    one bit a pixel, `pins` (n, P, 2) px, and what the solver says of each contact.
    """
    batches = engine.plan(sensor, settings.stimuli, samples.scenes)
    paths = [folder / f"{index:05d}.npz" for index in range(len(batches))]
    left = {
        path: batch for path, batch in zip(paths, batches, strict=True) if not _holds(path, batch)
    }
    total, scenes = len(samples.scenes), samples.scenes
    calls = (
        Call(
            path,
            _chunk,
            (settings, sensor, scenes.take(batch), np.asarray(batch), samples.age[batch], engine),
        )
        for path, batch in left.items()
    )
    label = f"simulate {get_set_name(settings)}/{compute_config_name(settings, sensor)}"
    with Progress(
        label, total, unit="contacts", done=total - sum(map(len, left.values()))
    ) as progress:
        for path, chunk in engine.run_calls(calls):
            if isinstance(chunk, WorkerDied):
                hint = (
                    "fewer at once (--ray-cores) have more memory each; then run the same command"
                )
                raise UserError(f"chunk {path.name}: {chunk.reason}; {hint}")
            write_npz(path, chunk)
            progress.advance(len(left[path]))
    return paths


def _holds(path: Path, batch: np.ndarray) -> bool:
    """Whether a killed run left this very batch; one planned by an older version is made again."""
    return path.exists() and np.array_equal(load_chunk(path)["number"], batch)


def _chunk(
    settings: PairedData | PoseData,
    sensor: Sensor,
    scenes: Scenes,
    number: np.ndarray,
    age: np.ndarray,
    engine: SimulationEngine,
) -> dict[str, np.ndarray]:
    """Of the contacts `number` (n,), which touch at `scenes` and `age`. A machine of a cluster needs no more than that."""
    contacts = engine.simulate(sensor, settings.stimuli, scenes)
    fields = {name: np.array(getattr(contacts, field)) for name, field in STORED_FIELDS.items()}
    usable, retried = _usable(contacts), np.asarray(contacts.retried)
    size = settings.preprocess.size
    tips = np.array(contacts.pins)
    images = np.zeros((len(number), -(-size * size // 8)), np.uint8)
    pins = np.zeros((*tips.shape[:2], 2), np.float32)
    if usable.any():
        seen, places = engine.render(settings, sensor, tips[usable], number[usable], age[usable])
        images[usable] = pack_bits(seen)
        pins[usable] = places
        usable &= images.any(axis=-1)  # a frame that is not finite comes out black
    return {
        "number": number,
        "usable": usable,
        "retried": retried,
        "images": images,
        "pins": pins,
        **fields,
    }


def load_chunk(path: Path) -> dict[str, np.ndarray]:
    try:
        return read_npz(path)
    except BROKEN_NPZ as error:
        raise UserError(
            f"chunk {path} cannot be read ({error}): delete it and run the same command again"
        ) from error


def iterate_usable_rows(
    paths: Iterable[Path], wanted: np.ndarray
) -> Iterator[tuple[dict[str, np.ndarray], int, int]]:
    """(chunk, place in it, row) of every usable contact that is `wanted` (N,), by row. Raises UserError for a damaged chunk."""
    for path in paths:
        chunk = load_chunk(path)
        for place in np.flatnonzero(chunk["usable"] & wanted[chunk["number"]]):
            yield chunk, int(place), int(chunk["number"][place])


def render_images(
    settings: PairedData | PoseData,
    sensor: Sensor,
    tips: np.ndarray,
    number: np.ndarray,
    age: np.ndarray,
    at_once: int = RENDER_BATCH,
) -> tuple[np.ndarray, np.ndarray]:
    """Images (B, S, S) uint8 in {0, 255} of pin tips (B, P, 3) in mm, and the pins' places (B, P, 2) in them, px. Fewer `at_once`, to
    which batches are filled up, take less time where there are never more."""
    images, pins = [], []
    for start in range(0, len(tips), at_once):
        rows = np.arange(start, min(start + at_once, len(tips)))
        padded = np.resize(rows, at_once)
        image, place = _render()(
            settings.camera,
            settings.nuisance,
            settings.preprocess,
            sensor,
            np.asarray(tips[padded], np.float32),
            np.uint32(settings.seed),
            np.asarray(number[padded], np.uint32),
            np.asarray(age[padded], np.float32),
        )
        images.append(np.asarray(image)[: len(rows)])
        pins.append(np.asarray(place)[: len(rows)])
    return np.concatenate(images), np.concatenate(pins)


@functools.cache
def _render() -> Callable[..., tuple[Array, Array]]:
    import jax

    from jaxunshear.perception.preprocess import binarise
    from jaxunshear.simulator import camera as cameras

    @functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
    def run(
        camera: Camera,
        nuisance: Nuisance,
        preprocess: Preprocess,
        sensor: Sensor,
        tips: Array,
        seed: Array,
        number: Array,
        age: Array,
    ) -> tuple[Array, Array]:
        def one(tip: Array, index: Array, when: Array) -> Array:
            key = jax.random.fold_in(jax.random.key(seed), index)
            return cameras.render_frame(camera, sensor, nuisance, tip, key, when)

        frames = jax.vmap(one)(tips, number, age)
        place = (
            cameras.project(camera, tips, sensor) + cameras.compute_drift(nuisance, age)[:, None, :]
        )
        return binarise(preprocess, frames), cameras.to_image_px(camera, preprocess, place)

    return run


def pack_bits(images: np.ndarray) -> np.ndarray:
    """(B, S, S) binary -> (B, bytes), one bit a pixel."""
    return np.packbits(images.reshape(len(images), -1) > 0, axis=-1)


def encode_stored_png(chunk: dict[str, np.ndarray], place: int, size: int) -> bytes:
    """One image of a chunk, as sets store it."""
    return encode_png(unpack_bits(chunk["images"][place], size), PNG_LEVEL)


def unpack_bits(bits: np.ndarray, size: int) -> np.ndarray:
    """(..., bytes) -> (..., S, S) uint8 in {0, 255}."""
    return np.unpackbits(bits, axis=-1, count=size * size).reshape(
        *bits.shape[:-1], size, size
    ) * np.uint8(255)
