"""Simulate contacts and render their images.

`simulate_chunks` makes those of a stored set, one file a batch, so that a killed run continues.
Files are written by the process that asked for them, wherever the contacts were made. What disturbs
an image depends on the seed and the contact's number alone, neither on the chunk nor on what was
done before.

`simulate_contacts` makes new contacts that no network was trained on. So anybody who has only the
weights can score them, too, without the data sets of the training.
"""

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from jaxunshear.cluster import Call, CallRunner, WorkerDied, run_locally
from jaxunshear.config.configs import compute_config_name
from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.layouts import LAYOUTS, LayoutFunction
from jaxunshear.config.sensor import Camera, Nuisance, Preprocess, Sensor
from jaxunshear.config.splits import BLOCK
from jaxunshear.data.chunks import Chunk, pack_bits, write_chunks
from jaxunshear.data.sampling import ContactSamples, sample_pairs
from jaxunshear.errors import UserError
from jaxunshear.perception.preprocess import binarise
from jaxunshear.simulator import camera as cameras
from jaxunshear.simulator import simulate
from jaxunshear.simulator.contacts import compute_indentation
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes

STORED_FIELDS = {  # of a chunk: the field of `Contacts` that it holds
    "residual_mm": "residual_mm",
    "iterations": "iterations",
    "stuck": "stuck_nodes",
    "slipping": "slipping_nodes",
    "free": "free_nodes",
}
RENDER_BATCH = 16  # images rendered at once: one shape to compile, little memory
SCALE_TAPS = 300  # simulated taps that scales are fitted to
SEED = 1_000_003  # of new contacts, added to the data's


class SimulationEngine(NamedTuple):
    """What makes contacts and images; the tests put fast stand-ins here."""

    plan: Callable[..., list[np.ndarray]]  # (sensor, names, scenes) -> index batches
    simulate: Callable[..., Any]  # (sensor, names, scenes) -> Contacts
    # (settings, sensor, tips, number, age) -> images, pins in px
    render: Callable[..., tuple[np.ndarray, np.ndarray]]
    run_calls: CallRunner = run_locally  # who makes the chunks


def make_engine(run_calls: CallRunner = run_locally) -> SimulationEngine:
    """Make the engine that simulates and renders."""
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
    scenes, layout = samples.scenes, LAYOUTS[sensor.layout]
    batches = engine.plan(sensor, settings.stimuli, scenes)

    def make_call(index: int) -> Call:
        batch = batches[index]
        given = (settings, sensor, layout, scenes.take(batch), batch, samples.age[batch], engine)
        return Call(Path(f"{index:05d}"), _simulate_chunk, given)

    def make(missing: list[int]) -> Iterator[tuple[int, Chunk]]:
        for name, chunk in engine.run_calls(map(make_call, missing)):
            if isinstance(chunk, WorkerDied):
                raise UserError(
                    f"chunk {name}: {chunk.reason}; fewer at once (--ray-cores) "
                    "have more memory each; then run the same command"
                )
            yield int(name.name), chunk

    label = f"simulate {settings.set_name}/{compute_config_name(settings, sensor)}"
    return write_chunks(folder, batches, make, label)


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
    tips = np.array(contacts.pins)
    is_finite = np.isfinite(contacts.pins).all((1, 2)) & np.isfinite(contacts.residual_mm)
    usable = is_finite & np.asarray(contacts.converged, bool)
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


class SimulatedContacts(NamedTuple):
    """N slides, each with the tap at its pose, less the contacts that did not converge."""

    stimulus: np.ndarray  # (N,) index into the experiment's
    pose: np.ndarray  # (N, 4) x, y mm, yaw deg, depth mm
    tap: np.ndarray  # (N, S, S) uint8 of {0, 255}
    sheared: np.ndarray  # (N, S, S)
    tap_pins: np.ndarray  # (N, P, 2) px
    sheared_pins: np.ndarray  # (N, P, 2)
    indentation_mm: np.ndarray  # (N, P) of the tap
    dropped: int


def simulate_contacts(
    experiment: Experiment, count: int, seed: int = 0, depth_mm: float | None = None
) -> SimulatedContacts:
    """Simulate slides at new poses, as many of each stimulus, and the tap at each pose.

    There are `count` of them, rounded up to the same number for each stimulus, and at least 5 per
    stimulus (a block of the split); less those that did not converge. `depth_mm` sets one depth for
    all, else depths are the experiment's. The same seed gives the same contacts.
    """
    paired = experiment.paired.require_simulation("this")
    poses = max(BLOCK, -(-count // len(paired.stimuli)))
    new = paired.seed + SEED + seed
    settings = replace(paired, poses=poses, taps=1, slides=1, tap_depth_jitter_mm=0.0, seed=new)
    if depth_mm is not None:
        ranges = replace(settings.ranges, depth_min_mm=depth_mm, depth_max_mm=depth_mm)
        settings = replace(settings, ranges=ranges)
    samples = sample_pairs(settings)
    contacts, skins = simulate.follow(experiment.sensor, paired.stimuli, make_paths(samples.scenes))
    # Both are in the same order, as there are one tap and one slide at a pose.
    slides, taps = np.flatnonzero(samples.is_slide), np.flatnonzero(~samples.is_slide)
    converged = contacts.converged[slides] & contacts.converged[taps]
    slides, taps = slides[converged], taps[converged]
    rows = np.concatenate([taps, slides])
    images, pins = render_images(
        settings, experiment.sensor, contacts.pins[rows], rows, samples.age[rows]
    )
    half = len(slides)
    return SimulatedContacts(
        stimulus=samples.scenes.stimulus[slides],
        pose=samples.scenes.pose[slides],
        tap=images[:half],
        sheared=images[half:],
        tap_pins=pins[:half],
        sheared_pins=pins[half:],
        indentation_mm=compute_indentation(experiment.sensor, skins.take(taps)),
        dropped=int(np.sum(~converged)),
    )


def render_untouched_images(experiment: Experiment, count: int) -> np.ndarray:
    """Render images (N, S, S) uint8 of {0, 255} of the sensor that touches nothing.

    Their light, noise and wear are those of other images.
    """
    paired = experiment.paired.require_simulation("this")
    tips = np.repeat(compute_pin_tips(experiment.sensor)[None], count, axis=0)
    numbers, ages = SEED + np.arange(count), np.linspace(0, 1, count)
    images, _ = render_images(paired, experiment.sensor, tips, numbers, ages)
    return images
