"""Measures how well networks of one layout of pins serve the same dome with another layout.

The motions of the other layout's pins are interpolated to the places of the pins that the networks
know. All contacts are simulated, rendered and detected; their poses are new to the networks, which
are the released ones. `taps`, `slides` and `unsheared` are mean errors of poses by PoseNet.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import Delaunay

from jaxunshear.config.networks import DISENTANGLED, POSENET
from jaxunshear.config.sensor import Sensor
from jaxunshear.data.simulation import SimulatedContacts, simulate_contacts
from jaxunshear.files import Json
from jaxunshear.inference.trained_model import TrainedModel, load_model
from jaxunshear.metrics.errors import compute_error
from jaxunshear.models.posenet import unscale_outputs
from jaxunshear.models.registry import predict, unshear
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.progress import Progress
from jaxunshear.simulator.scene import compute_edge_labels, make_scenes
from jaxunshear.text_table import format_text_table
from jaxunshear.triangles import find_corners

WEIGHTS = ("skin", "skin127")
RINGS = {"rings": 10, "hexagonal": 6, "rectangular": 7}  # of each layout: 331, 127 and 165 pins
CONTACTS = 600  # slides, and as many taps
PIN_SIZE = 0.25  # radius over spacing
COLUMNS = ("name", "pins", "read", "taps", "slides", "unsheared")
format_table = partial(format_text_table, columns=COLUMNS)


def bench_layouts(seed: int = 0) -> list[Json]:
    """Return a row for each pose target of each released network and each layout on its dome."""
    rows: list[Json] = []
    with Progress("bench layouts", len(WEIGHTS) * len(RINGS), unit="layouts") as progress:
        for name in WEIGHTS:
            model = load_model(name)
            for layout in RINGS:
                rows += _measure(name, model, set_layout(model.sensor, layout), seed)
                progress.advance()
    return rows


def set_layout(sensor: Sensor, layout: str) -> Sensor:
    """Set the layout of a dome's pins, which reach as far from the apex as before."""
    if layout == sensor.layout:
        return sensor
    other = replace(sensor, name=f"{sensor.name}-{layout}", layout=layout, rings=RINGS[layout])
    reach = [np.linalg.norm(each.place_pins(), axis=-1).max() for each in (sensor, other)]
    spacing = float(sensor.pin_spacing_mm * reach[0] / reach[1])
    return replace(other, pin_spacing_mm=spacing, pin_radius_mm=PIN_SIZE * spacing)


def _measure(name: str, model: TrainedModel, sensor: Sensor, seed: int) -> Iterator[Json]:
    experiment = replace(model.experiment, sensor=sensor)
    contacts = simulate_contacts(experiment, CONTACTS, seed)
    paired = model.require_simulation("this")
    lattice = compute_rest_lattice(sensor, paired.camera, paired.preprocess)
    images = np.concatenate([contacts.tap, contacts.sheared])
    tracks = track_all(lattice, [detect_pins(image) for image in images])
    motion = np.array([lattice.fill_holes(track.motion) for track in tracks])
    identified = np.array([track.identified for track in tracks]).reshape(2, -1)
    read = identified[0] & identified[1]  # contacts whose tap and slide are both read
    pins = interpolate_pins(lattice, motion, model.lattice.rest).reshape(2, len(read), -1, 2)
    errors = compute_errors(model, contacts, *pins)
    for target in errors["taps"]:
        yield {
            "name": f"{name}/{sensor.layout}/{target}",
            "pins": sensor.pins,
            "read": round(float(identified.mean()), 4),
        } | {kind: round(float(values[target][read].mean()), 4) for kind, values in errors.items()}


def interpolate_pins(
    lattice: Lattice, motion: Float[np.ndarray, "B P 2"], rest: Float[np.ndarray, "Q 2"]
) -> Float[np.ndarray, "B Q 2"]:
    """Move pins from `rest` as the pins of a lattice between which they stand; lengths are px."""
    corners, weights, _ = find_corners(Delaunay(lattice.rest), rest)
    return rest + np.einsum("qc,bqci->bqi", weights, motion[:, corners])


def compute_errors(
    model: TrainedModel,
    contacts: SimulatedContacts,
    taps: Float[np.ndarray, "B P 2"],
    slides: Float[np.ndarray, "B P 2"],
) -> dict[str, dict[str, np.ndarray]]:
    """Compute pose errors (B,) by kind of input and target."""
    stimuli = model.require_simulation("this").stimuli
    still = np.zeros((len(contacts.pose), 3))
    scenes = make_scenes(stimuli, contacts.stimulus, contacts.pose, still, 0.0)
    edge = compute_edge_labels(stimuli, scenes)
    true = {"edge_mm": edge[:, 0], "edge_deg": edge[:, 1], "depth_mm": contacts.pose[:, 3]}
    net, posenet = (model.load_network(name) for name in (DISENTANGLED, POSENET))
    inputs = {"taps": jnp.asarray(taps, jnp.float32), "slides": jnp.asarray(slides, jnp.float32)}
    inputs["unsheared"] = unshear(net.net, net.variables, inputs["slides"])
    errors = {}
    for kind, pins in inputs.items():
        outputs = predict(posenet.net, posenet.variables, pins)
        poses = unscale_outputs(outputs, posenet.targets)
        errors[kind] = {
            name: compute_error(name, np.asarray(poses[name]) - true[name]) for name in true
        }
    return errors
