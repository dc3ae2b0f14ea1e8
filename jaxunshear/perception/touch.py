"""What the pins' motion says of a contact, whatever the networks: touch, slip, shear and strain.

    gauge = make_touch_gauge(lattice, TACTIP_331)  # where pins stand while nothing is touched
    touch = measure_touch(gauge, lattice.rest + track_images(lattice, images).motion)
    touch.contact  # (B,) probability that the dome is touched

Motions are in mm, less that of the rim, which contacts hardly move: a camera that shifts moves all
pins alike. A plane is fitted to the motions around each pin; its slope gives divergence and curl.
Means over groups of rings, which are the same however the sensor is turned, go into regressions
that were learnt from simulated contacts (`touch.json`, by `python -m benchmarks touch`). Slip shows
around the middle of the contact, wherever that lies: a small network takes means over rings there.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.special import expit

from jaxunshear.config.sensor import (
    FITTED_CAMERA,
    TACTIP_331_FITTED,
    Camera,
    MarkerSensor,
    Preprocess,
    Sensor,
)
from jaxunshear.files import Json, read_object
from jaxunshear.perception.lattice import Lattice, find_rim, make_lattice
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.simulator.pin_layout import compute_pin_tips

WEIGHTS = Path(__file__).with_name("touch.json")
MIN_CONTACT = 0.5  # probability below which an image shows no contact
CERTAIN_CONTACT = 0.99  # from which on pins that are not tracked show a contact, too
MAX_MOTION = 0.4  # of the spacing, up to which a pin is the one next to its place
MIN_RIM_SHARE = 0.8  # of the rim's pins that must be so
NO_CONTACT_REASON = "no contact"
ZONES = (0.0, 0.3, 0.55, 0.8, 1.01)  # of the rim's radius: limits between groups of rings
CONTACT_STRAIN = 0.5  # of the largest: from here on a pin belongs to the contact
MIDDLE_STRAIN = 0.4  # of the largest: the strain beyond it weighs pins to find the middle
CONTACT_RINGS_MM = (0.0, 2.0, 4.0, 7.0, 11.0)  # limits between rings around that middle
NEAR_MIDDLE_MM = 0.3  # least distance that a direction from the middle is divided by
SHEAR_FLOOR = (0.2, 1.0)  # mm and deg: an error grows with the shear from here on
LEAST = 1e-4  # mm, or mm per mm, that is added before a logarithm


class TouchGauge(NamedTuple):
    """The pins of a sensor that touches nothing, and what measures motions from there."""

    lattice: Lattice
    place_mm: np.ndarray  # (P, 2) mm from the middle
    mm_per_px: float
    near: np.ndarray  # (P, N) each pin and its neighbours
    plane: np.ndarray  # (P, 3, N): of motions of `near` makes the value at the pin, and its slopes
    zones: np.ndarray  # (Z, P): takes means over groups of rings
    stiffness: float  # of the skin over the gel's
    weights: "TouchWeights"


class MotionField(NamedTuple):
    """The motions of B images, each smoothed over a pin's neighbours."""

    motion_mm: np.ndarray  # (B, P, 2) as (column, row), the rim's subtracted
    divergence: np.ndarray  # (B, P) mm per mm; positive where pins part
    curl: np.ndarray  # (B, P) mm per mm; positive from columns towards rows
    strain: np.ndarray  # (B, P) mm per mm: size of the slope less its rotation
    noise_mm: np.ndarray  # (B,) of one pin, against its neighbours


class TouchFeatures(NamedTuple):
    """Features of B fields, by group of rings.

    All but `vectors` do not depend on how the sensor is turned.
    """

    sizes: np.ndarray  # (B, 1 + Z) logarithms of the noise's and the motion's
    slide: np.ndarray  # (B, S) around the middle of the contact, along its drag
    vectors: np.ndarray  # (B, Z, 2) mm, which turn with the sensor
    turns: np.ndarray  # (B, T), which change their sign in a mirror
    divergence: np.ndarray  # (B,) mean over the contact, mm per mm
    curl: np.ndarray  # (B,)


class TouchWeights(NamedTuple):
    """What was learnt; the last row of `contact`, `slip_units` and `slip` is added."""

    contact: np.ndarray  # (Z + 2,) of the features `sizes`
    slip_units: np.ndarray  # (S + 1, U) of the features `slide`, before the tanh of each unit
    slip: np.ndarray  # (U + 1,) of the units
    shear: np.ndarray  # (Z,)
    turn: np.ndarray  # (T,)
    half_width: np.ndarray  # (2,) of the shear's mm and deg, over its size and SHEAR_FLOOR


class Touch(NamedTuple):
    """What B images show; NaN for one whose pins are not followed.

    Where nothing is touched, slip and shear are NaN, too.
    """

    contact: np.ndarray  # (B,) probability that the dome is touched
    slip: np.ndarray  # (B,) share of the contact that slides, in [0, 1]
    shear_x_mm: np.ndarray  # (B,) along columns: how far friction has dragged the skin
    shear_y_mm: np.ndarray  # (B,) along rows
    shear_deg: np.ndarray  # (B,) and turned it, from columns towards rows
    shear_half_width_mm: np.ndarray  # (B,) of the interval about x, and y, that holds 95 %
    shear_half_width_deg: np.ndarray  # (B,)
    divergence: np.ndarray  # (B,) mean over the contact, mm per mm
    curl: np.ndarray  # (B,)

    def describe(self, row: int) -> dict[str, float]:
        """Describe one image by field, without those that are NaN."""
        values = {name: float(values[row]) for name, values in self._asdict().items()}
        return {name: value for name, value in values.items() if np.isfinite(value)}


def make_touch_gauge(untouched: Lattice, sensor: Sensor) -> TouchGauge:
    """Make the gauge of the lattice of a sensor that touches nothing."""
    tips = compute_pin_tips(sensor)[:, :2]
    centred = untouched.rest - untouched.rest.mean(axis=0)
    mm_per_px = float(np.linalg.norm(tips - tips.mean(axis=0)) / np.linalg.norm(centred))
    stiffness = sensor.skin_modulus_mpa / sensor.gel_modulus_mpa
    return make_scaled_gauge(untouched, mm_per_px, stiffness, _select_weights(sensor))


def _select_weights(sensor: Sensor) -> TouchWeights:
    """Select what was learnt on domes; NaN for other sensors, on which nothing was learnt."""
    weights = load_weights()
    if sensor.is_flat or isinstance(sensor, MarkerSensor):
        return TouchWeights(*(np.full_like(each, np.nan) for each in weights))
    return weights


def make_scaled_gauge(
    untouched: Lattice, mm_per_px: float, stiffness: float, weights: TouchWeights
) -> TouchGauge:
    """Make the gauge of the lattice of a sensor whose scale and stiffness are known."""
    place = mm_per_px * (untouched.rest - untouched.centre)
    near = np.column_stack([np.arange(len(place)), untouched.neighbours])
    offset = place[near] - place[:, None]
    share = 1 / (1 + np.square(offset).sum(-1) / (mm_per_px * untouched.spacing) ** 2)
    design = np.concatenate([np.ones((*near.shape, 1)), offset], axis=-1)
    weighted = np.swapaxes(design * share[..., None], -1, -2)
    plane = np.linalg.solve(weighted @ design, weighted)
    radius = np.linalg.norm(place, axis=-1)
    zones = np.eye(len(ZONES) - 1)[:, np.digitize(radius / radius.max(), ZONES) - 1]
    zones = zones / np.maximum(zones.sum(axis=1, keepdims=True), 1)
    return TouchGauge(untouched, place, mm_per_px, near, plane, zones, stiffness, weights)


def make_recorded_gauge(lattice: Lattice, sensor: Sensor) -> TouchGauge:
    """Make the gauge of a camera, of whose lattice the mean over contacts is known.

    A layout file has no millimetres, so that contact, slip and shear remain unknown. Of other
    sensors contacts move the rim least. Within, each ring is drawn to the radius that it has at the
    simulated camera. Of 331 pins that one, and the sensor, were fitted to real images.
    """
    if isinstance(sensor, MarkerSensor):
        return make_scaled_gauge(lattice, 1.0, 1.0, _select_weights(sensor))
    is_fitted = lattice.rest.shape == (TACTIP_331_FITTED.pins, 2)
    sensor, camera = (TACTIP_331_FITTED, FITTED_CAMERA) if is_fitted else (sensor, Camera())
    model = compute_rest_lattice(sensor, camera, Preprocess())
    wanted, known = _measure_ring_radii(model), _measure_ring_radii(lattice)
    scale = wanted / wanted[-1] * known[-1] / known
    scale[0] = 1  # of the pin in the middle
    offset = lattice.rest - lattice.centre
    rest = lattice.centre + scale[lattice.ring, None] * offset
    return make_touch_gauge(make_lattice(rest, lattice.ring, lattice.lost), sensor)


def _measure_ring_radii(lattice: Lattice) -> np.ndarray:
    radius = np.linalg.norm(lattice.rest - lattice.centre, axis=-1)
    return np.bincount(lattice.ring, radius) / np.bincount(lattice.ring)


def measure_field(gauge: TouchGauge, pins: Float[np.ndarray, "B P 2"]) -> MotionField:
    """Measure the motion of pins px from the untouched lattice, NaN for those that are missing."""
    lattice = gauge.lattice
    full = [lattice.fill_missing(each - lattice.rest) for each in pins]
    motion = gauge.mm_per_px * np.reshape(full, (-1, *lattice.rest.shape))
    motion = motion - np.median(motion[:, find_rim(lattice.ring)], axis=1, keepdims=True)
    smooth = np.einsum("pkn,bpnc->kcbp", gauge.plane, motion[:, gauge.near])
    (xx, yx), (xy, yy) = smooth[1:]  # of x and y, along x; then along y
    offset = np.square(motion - lattice.neighbour_weights @ motion).sum(-1)
    return MotionField(
        motion_mm=np.moveaxis(smooth[0], 0, -1),
        divergence=xx + yy,
        curl=yx - xy,
        strain=np.sqrt(xx**2 + yy**2 + (xy + yx) ** 2 / 2),
        noise_mm=np.sqrt(np.median(offset, axis=1) / (2 * np.log(2))),
    )


def describe_field(gauge: TouchGauge, field: MotionField) -> TouchFeatures:
    """Describe fields by means over groups of rings."""

    def average(values: np.ndarray) -> np.ndarray:
        return values @ gauge.zones.T

    motion, outward = field.motion_mm, gauge.place_mm
    outward = outward / np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), LEAST)
    turned = average(motion[..., 1] * outward[:, 0] - motion[..., 0] * outward[:, 1])
    size = np.sqrt(average(np.square(motion).sum(-1)))
    mean = np.stack([average(motion[..., axis]) for axis in (0, 1)], axis=-1)
    touched = field.strain >= CONTACT_STRAIN * field.strain.max(axis=1, keepdims=True)
    return TouchFeatures(
        np.log(np.column_stack([field.noise_mm, size]) + LEAST),
        _describe_slide(gauge, field),
        mean,
        np.concatenate([average(field.curl), turned], axis=1),
        *(np.mean(each, axis=1, where=touched) for each in (field.divergence, field.curl)),
    )


def _describe_slide(gauge: TouchGauge, field: MotionField) -> Float[np.ndarray, "B S"]:
    """Describe fields by means over rings around the contact's middle, along its drag.

    A contact that sticks in its middle moves there as if it were rigid, and departs from that in a
    ring. Motions are divided by the largest one, strains by the largest strain. No feature depends
    on how the sensor is turned or mirrored.
    """
    strain, motion, share = field.strain, field.motion_mm, _weigh_strained_pins(field.strain)
    largest = strain.max(axis=1)
    drag = np.einsum("bp,bpc->bc", share, motion)
    drag_mm = np.linalg.norm(drag, axis=-1)
    along = drag / np.maximum(drag_mm, LEAST)[:, None]
    axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=-1)])  # and across
    offset = gauge.place_mm - (share @ gauge.place_mm)[:, None]
    ahead, aside = np.einsum("bpc,abc->abp", offset, axes)
    forward, sideways = np.einsum("bpc,abc->abp", motion, axes)
    distance = np.hypot(ahead, aside)
    reach = np.maximum(distance, NEAR_MIDDLE_MM)
    ring, outer_mm = _weigh_rings(distance), np.array(CONTACT_RINGS_MM[1:])

    def average(values: np.ndarray) -> np.ndarray:
        mean: np.ndarray = np.einsum("brp,bp->br", ring, values)
        return mean

    motion_mm = np.linalg.norm(motion, axis=-1).max(axis=1)
    second = (ahead**2 - aside**2) / reach**2
    sizes = [
        np.full(len(motion), gauge.stiffness),
        field.noise_mm,
        drag_mm,
        motion_mm,
        np.sqrt(np.sum(share * distance**2, axis=1)),  # mm from the middle to the strained pins
        largest,
        strain.mean(axis=1) / np.maximum(largest, LEAST),  # without a limit, where it would jump
    ]
    dragged = average(forward)
    motions = [
        dragged,
        average((forward * ahead + sideways * aside) / reach),
        np.abs(average((sideways * ahead - forward * aside) / reach)),
        average(forward * second) - dragged * average(second),
    ]
    strains = [  # before the middle less behind it; to its left less to its right
        average(field.divergence * ahead) / outer_mm,
        average(field.curl * aside) / outer_mm,
    ]
    rings = [each / np.maximum(motion_mm, LEAST)[:, None] for each in motions]
    rings += [each / np.maximum(largest, LEAST)[:, None] for each in strains]
    return np.concatenate([np.log(np.stack(sizes, axis=-1) + LEAST), *rings], axis=1)


def _weigh_strained_pins(strain: np.ndarray) -> Float[np.ndarray, "B P"]:
    """Weigh pins for the middle of the contact, by how far they are strained (B, P)."""
    share = np.maximum(strain - MIDDLE_STRAIN * strain.max(axis=1, keepdims=True), 0)
    return share / np.maximum(share.sum(axis=1, keepdims=True), LEAST)


def _weigh_rings(distance: np.ndarray) -> Float[np.ndarray, "B R P"]:
    """Weigh pins for means over rings, by their distances (B, P) mm from the contact's middle."""
    limits = np.array(CONTACT_RINGS_MM)
    middle, width = (limits[1:] + limits[:-1]) / 2, np.diff(limits) / 1.5
    ring = np.exp(-np.square((distance[:, None] - middle[:, None]) / width[:, None]))
    return ring / np.maximum(ring.sum(axis=-1, keepdims=True), LEAST)


@cache
def load_weights(path: Path = WEIGHTS) -> TouchWeights:
    """Load weights that `python -m benchmarks touch` wrote."""
    stored: Json = read_object(path)
    return TouchWeights(*(np.array(stored[name]) for name in TouchWeights._fields))


def predict_touch(weights: TouchWeights, features: TouchFeatures) -> Touch:
    """Predict what B images show."""
    contact = expit(features.sizes @ weights.contact[:-1] + weights.contact[-1])
    units = np.tanh(features.slide @ weights.slip_units[:-1] + weights.slip_units[-1])
    touched = np.where(contact < MIN_CONTACT, np.nan, 1.0)
    shear_mm = np.einsum("bzc,z->cb", features.vectors, weights.shear) * touched
    turn_deg = features.turns @ weights.turn * touched
    return Touch(
        contact=contact,
        slip=expit(units @ weights.slip[:-1] + weights.slip[-1]) * touched,
        shear_x_mm=shear_mm[0],
        shear_y_mm=shear_mm[1],
        shear_deg=turn_deg,
        shear_half_width_mm=weights.half_width[0] * (SHEAR_FLOOR[0] + np.hypot(*shear_mm)),
        shear_half_width_deg=weights.half_width[1] * (SHEAR_FLOOR[1] + np.abs(turn_deg)),
        divergence=features.divergence,
        curl=features.curl,
    )


def measure_touch(gauge: TouchGauge, pins: Float[np.ndarray, "B P 2"]) -> Touch:
    """Measure what pins px show of a contact; an image that is not followed has NaN alone."""
    followed = np.isfinite(pins).any(axis=(1, 2))
    features = describe_field(gauge, measure_field(gauge, pins[followed]))
    touch = predict_touch(gauge.weights, features)
    values = np.full((len(touch), len(pins)), np.nan)
    values[:, followed] = touch
    return Touch(*values)


def may_touch_nothing(gauge: TouchGauge, detected: Float[np.ndarray, "N 2"]) -> bool:
    """Say whether pins px whose identities are not known may be of a dome that touches nothing.

    On an untouched dome each detected dot is the pin of the nearest rest position. If motions by
    this assignment show a contact, the dome is touched.
    """
    if not len(detected):
        return True
    lattice = gauge.lattice
    limit, rim, tree = MAX_MOTION * lattice.spacing, find_rim(lattice.ring), cKDTree(detected)
    nearest = tree.query(lattice.rest[rim])[1]
    shift = np.median(detected[nearest] - lattice.rest[rim], axis=0)
    distance, nearest = tree.query(lattice.rest + shift)
    if np.mean(distance[rim] < limit) < MIN_RIM_SHARE:  # pins half a spacing off cannot be assigned
        return True
    pins = np.where(distance[:, None] < limit, detected[nearest], np.nan)
    return bool(measure_touch(gauge, pins[None]).contact[0] < CERTAIN_CONTACT)


def find_no_contact(touch: Touch) -> Bool[np.ndarray, "B"]:
    """Find the images of a dome that touches nothing; NaN is not counted as no contact."""
    return touch.contact < MIN_CONTACT
