"""How the images of a sensor become inputs of networks, and what these give becomes images again.

Networks over images take them as they are. For networks over pins, pins are detected and tracked,
and unsheared pins are drawn as dots.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import orthogonal_procrustes

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.sensor import Preprocess, Sensor
from jaxunshear.data.recordings import PROBES
from jaxunshear.data.sensor_frame import SensorFrame, to_image_px
from jaxunshear.errors import UserError
from jaxunshear.inference.forward import AS_RECORDED, BATCH, UNSHEARED, compute_confidence
from jaxunshear.models.registry import run_in_batches
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.grey import ONE_BYTE
from jaxunshear.perception.lattice import Lattice, make_lattice
from jaxunshear.perception.pin_tracking import measure_motions, track_images
from jaxunshear.perception.preprocess import View, combine_views, find_view
from jaxunshear.perception.sensor_check import (
    FOREIGN_REASON,
    MIN_PLAUSIBILITY,
    UNIDENTIFIED_REASON,
    SensorAppearance,
    judge_image,
)
from jaxunshear.perception.touch import (
    NO_CONTACT_REASON,
    Touch,
    TouchGauge,
    find_no_contact,
    make_recorded_gauge,
    make_scaled_gauge,
    make_touch_gauge,
    may_touch_nothing,
    measure_touch,
)

EDGE = "edge_deg"  # the target that rotates with the image

Poses = dict[str, dict[str, np.ndarray]]  # by kind of input and quantity, (B,)
Unshear = Callable[[np.ndarray], Array]  # network inputs -> unsheared
PinTransform = Callable[[np.ndarray], np.ndarray]  # of pins (B, P, 2) px


class NetworkInputs(NamedTuple):
    """Inputs of networks for a batch."""

    values: np.ndarray  # images (B, S, S) uint8, or pins (B, P, 2) px, NaN if one was not detected
    identified: np.ndarray  # (B,) whether pins were identified, or none are needed
    pins: np.ndarray | None = None  # (B, P, 2) px in the image, for pin networks


class NetworkOutputs(NamedTuple):
    """Outputs of networks for a batch, also for images to be rejected."""

    unsheared: np.ndarray | None  # (B, S, S) in [0, 1]
    poses: Poses
    pins: dict[str, np.ndarray]  # by kind, (B, P, 2) px, of pin networks alone


class Predictions(NamedTuple):
    """The results for B images; those of rejected images are NaN."""

    unsheared: np.ndarray | None  # (B, S, S) in [0, 1]; None if no network unshears
    poses: Poses
    pins: dict[str, np.ndarray]  # by kind, (B, P, 2) px, of pin networks alone
    rejection: np.ndarray  # (B,) of text: why an image is rejected; empty if it is not
    # (B,) in [0, 1]: how likely the image is one of the model's sensor, times how near the spacing
    # of its pins is to the model's, times `compute_confidence` of the unsheared image, which is 1
    # over pins; 0 if it is rejected
    confidence: np.ndarray
    measure_touch: Callable[[], Touch]  # once; of networks over images it tracks the pins

    @property
    def touch(self) -> Touch:
        """What pins show of the contact; measured when it is first asked for."""
        return self.measure_touch()


class PredictedBatch(NamedTuple):
    """The first fields of `Predictions`, and the touch of images where it is measured."""

    unsheared: np.ndarray | None
    poses: Poses
    pins: dict[str, np.ndarray]
    rejection: np.ndarray
    confidence: np.ndarray
    touch: Touch
    measured: np.ndarray  # (B,) bool


class Codes(NamedTuple):
    """Latent codes of B images, each code as a row of numbers."""

    pose: np.ndarray  # z_p, (B, F)
    shear: np.ndarray | None  # z_s, (B, G); None for weights without it, such as released ones


class FrameTransforms(NamedTuple):
    """Between the pins of an image and those that networks were trained on."""

    to_model: PinTransform
    from_model: PinTransform
    degrees: float  # rotation of the image's lattice against the model's


class ImageReader:
    """For networks over images. `PinReader` has the same members."""

    def read(self, images: np.ndarray) -> NetworkInputs:
        """Make inputs of networks of images (B, S, S) uint8 of {0, 255}."""
        return NetworkInputs(images, np.ones(len(images), bool))

    def finish(
        self, inputs: NetworkInputs, unsheared: np.ndarray | None, poses: Poses
    ) -> NetworkOutputs:
        """Make images and poses of these images of what the networks gave."""
        return NetworkOutputs(None if unsheared is None else unsheared[..., 0], poses, {})

    def measure_unsheared_motions(
        self, lattice: Lattice, unshear: Unshear, images: np.ndarray
    ) -> np.ndarray:
        """Measure pin motions (N, P, 2) px in unsheared images; NaN if not identified."""
        return measure_motions(lattice, run_in_batches(unshear, images, BATCH)[..., 0])


def read_pins(
    lattice: Lattice,
    frame: SensorFrame | None,
    transforms: FrameTransforms | None,
    images: np.ndarray,
) -> NetworkInputs:
    """Find pins in images (B, S, S) uint8 of {0, 255}; `PinReader` has the other arguments."""
    motion, identified = track_images(lattice, images, independent=True)
    pins = values = lattice.rest + motion
    if frame is not None and transforms is not None:
        pins = to_image_px(frame, pins)
        filled = lattice.rest + np.array([lattice.fill_holes(row) for row in motion])
        values = transforms.to_model(to_image_px(frame, filled))
    return NetworkInputs(values.astype(np.float32), identified, pins)


def turn_pose(pose: dict[str, np.ndarray], degrees: float) -> dict[str, np.ndarray]:
    """Turn poses (B,), by quantity, from the model's lattice to one at `degrees` from it."""
    return pose | {name: wrap_degrees(pose[name] + degrees) for name in (EDGE,) if name in pose}


class PinReader(NamedTuple):
    """For networks over pins."""

    lattice: Lattice  # rest positions in the images
    frame: SensorFrame | None = None  # of a camera; None: the images and the pins are the model's
    transforms: FrameTransforms | None = None

    def read(self, images: np.ndarray) -> NetworkInputs:
        return read_pins(self.lattice, self.frame, self.transforms, images)

    def finish(
        self, inputs: NetworkInputs, unsheared: np.ndarray | None, poses: Poses
    ) -> NetworkOutputs:
        assert self.frame is not None and self.transforms is not None and inputs.pins is not None
        pins, image = {AS_RECORDED: inputs.pins}, None
        if unsheared is not None:
            pins[UNSHEARED] = self.transforms.from_model(unsheared)
            dots = draw_dots(jnp.asarray(pins[UNSHEARED]), self.frame.radius_px, self.frame.size)
            image = np.asarray(dots)[..., 0]
        poses = {kind: turn_pose(pose, self.transforms.degrees) for kind, pose in poses.items()}
        return NetworkOutputs(image, poses, pins)

    def measure_unsheared_motions(
        self, lattice: Lattice, unshear: Unshear, images: np.ndarray
    ) -> np.ndarray:
        motion, identified = track_images(lattice, images)
        pins = (lattice.rest + motion).astype(np.float32)
        unsheared = run_in_batches(unshear, pins, BATCH) - lattice.rest
        return np.where(identified[:, None, None], unsheared, np.nan)


Reader = ImageReader | PinReader


class TouchReader(NamedTuple):
    """For what pins show of a contact, whatever the networks take."""

    lattice: Lattice  # against which pins are tracked
    gauge: TouchGauge

    def measure(self, images: np.ndarray, pins: np.ndarray | None) -> Touch:
        """Measure images (B, S, S) of {0, 255}, whose pins (B, P, 2) px may be known."""
        return measure_touch(self.gauge, self.track(images) if pins is None else pins)

    def measure_rows(self, images: np.ndarray, rows: np.ndarray, touch: Touch) -> Touch:
        """Fill the rows (B,) bool of `touch` with measurements of `images`, one image per row."""
        values = np.array(touch)
        if rows.any():
            values[:, rows] = self.measure(images, None)
        return Touch(*values)

    def measure_some(
        self, images: np.ndarray, pins: np.ndarray | None, judged: "Judgement", force: bool
    ) -> tuple[Touch, np.ndarray]:
        """Measure all images if pins are known; else only those that may show no contact.

        Also return which of the B images were measured, (B,) bool.
        """
        if pins is not None:
            return self.measure(images, pins), np.ones(len(images), bool)
        reasons = zip(judged.rejection.tolist(), judged.pins, strict=True)
        rows = np.array(
            [
                not (force or reason) and may_touch_nothing(self.gauge, detected)
                for reason, detected in reasons
            ]
        )
        nothing = Touch(*np.full((len(Touch._fields), len(images)), np.nan))
        return self.measure_rows(images[rows], rows, nothing), rows

    def learn_rest_positions(self, images: np.ndarray, pins: np.ndarray | None) -> "TouchReader":
        """Return the reader that measures from the mean of these images, of an untouched dome."""
        pins = self.track(images) if pins is None else pins
        return self._replace(gauge=learn_gauge(self.gauge, pins))

    def track(self, images: np.ndarray) -> np.ndarray:
        """Find the pins (B, P, 2) px of images (B, S, S), NaN for one that is not seen."""
        rest: np.ndarray = self.lattice.rest
        return rest + track_images(self.lattice, images, independent=True).motion


def learn_gauge(gauge: TouchGauge, pins: np.ndarray) -> TouchGauge:
    """Make the gauge anew of pins (B, P, 2) px in images of an untouched dome. Raises UserError."""
    lattice, pins = gauge.lattice, pins.copy()
    pins[:, list(lattice.lost)] = lattice.rest[list(lattice.lost)]
    count = np.isfinite(pins[..., 0]).sum(axis=0)
    if not count.all():
        raise UserError(
            f"of {np.sum(count == 0)} pins no place is known in {len(pins)} images of the "
            "untouched dome: give images in which all pins are identified"
        )
    rest = make_lattice(np.nanmean(pins, axis=0), lattice.ring, lattice.lost)
    return make_scaled_gauge(rest, gauge.mm_per_px, gauge.stiffness, gauge.weights)


def make_touch_reader(rest: Lattice | SensorFrame, sensor: Sensor) -> TouchReader:
    """Make the reader of images of a simulated sensor, or of a camera's frames.

    Of these no untouched dome is known, but the mean over contacts.
    """
    if isinstance(rest, Lattice):
        return TouchReader(rest, make_touch_gauge(rest, sensor))
    lattice = make_lattice(rest.rest, rest.ring, rest.lost)
    return TouchReader(lattice, make_recorded_gauge(lattice, sensor))


def check_images(images: np.ndarray, size: int) -> np.ndarray:
    """Return images (B, size, size) as uint8 of {0, 255}. Raises UserError for others."""
    images = np.asarray(images)
    if images.ndim != 3 or images.shape[1:] != (size, size) or not len(images):
        raise UserError(
            f"images of shape {images.shape}: this model takes (B, {size}, {size}), "
            "B at least 1; `prepare` makes one of a camera's frame"
        )
    if images.dtype == bool:
        return images.astype(np.uint8) * np.uint8(255)
    if images.dtype != np.uint8 or ((images + ONE_BYTE) > 1).any():
        raise UserError(
            f"images of {images.dtype}: this model takes uint8 of 0 and 255 alone, or bool; "
            "`prepare` makes them"
        )
    return images


_compute_confidences = jax.jit(jax.vmap(compute_confidence))


def compute_confidences(unsheared: np.ndarray | None) -> np.ndarray | float:
    """Compute how sure each unsheared image (B, S, S) is; 1 if there are none."""
    return 1.0 if unsheared is None else np.asarray(_compute_confidences(unsheared[..., None]))


class Judgement(NamedTuple):
    """What B images are judged by."""

    rejection: np.ndarray  # (B,) of text: why an image is rejected; empty if it is not
    plausibility: np.ndarray  # (B,)
    familiarity: np.ndarray  # (B,)
    pins: tuple[np.ndarray, ...]  # (N, 2) px each, without identities


def judge_batch(
    images: np.ndarray, identified: np.ndarray, expected: SensorAppearance, force: bool
) -> Judgement:
    """Judge whether images are of the expected sensor, with their pins `identified` (B,).

    It is the rule of `TrainedModel`. `add_no_contact` adds the test for contact;
    `apps/export/sensor_check.py` has the rule of exported files. With `force` any sensor will do.
    Networks that need no identities take all pins as identified.
    """
    judged = [judge_image(image, expected) for image in images]
    plausibility, familiarity, pins = zip(*judged, strict=True)
    is_foreign = (np.array(plausibility) < MIN_PLAUSIBILITY) & (not force)
    rejection = np.where(is_foreign, FOREIGN_REASON, "")
    rejection = np.where(identified, rejection, UNIDENTIFIED_REASON)
    return Judgement(rejection, np.array(plausibility), np.array(familiarity), pins)


def add_no_contact(reasons: np.ndarray, touch: Touch, force: bool) -> np.ndarray:
    """Add to the reasons (B,) by which images are rejected that they show no contact."""
    refused = find_no_contact(touch) & (reasons == "") & (not force)
    return np.where(refused, NO_CONTACT_REASON, reasons)


def make_pin_reader(frame: SensorFrame, model_rest: np.ndarray) -> PinReader:
    """Make the reader of a camera's frames for networks over pins that rest at (P, 2) px."""
    lattice = frame.make_detection_lattice()
    return PinReader(lattice, frame, make_frame_transforms(frame.rest, model_rest))


def make_frame_transforms(image_rest: np.ndarray, model_rest: np.ndarray) -> FrameTransforms:
    """Fit the rotation and scale between two lattices (P, 2), which pins' motions follow."""
    centred = image_rest - image_rest.mean(axis=0)
    target = model_rest - model_rest.mean(axis=0)
    turn, scale = orthogonal_procrustes(centred, target)
    scale = scale / np.square(centred).sum()
    degrees = float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))

    def to_model(pins: np.ndarray) -> np.ndarray:
        return model_rest + scale * (pins - image_rest) @ turn

    def from_model(pins: np.ndarray) -> np.ndarray:
        return image_rest + (pins - model_rest) @ turn.T / scale

    return FrameTransforms(to_model, from_model, degrees)


def make_steady_view(preprocess: Preprocess) -> Callable[[np.ndarray], View]:
    """Make a function from a camera's frames, one by one, to the view that they have in common.

    It is the crop of the first PROBES usable frames of each size, as far as they have come.
    """
    views: dict[tuple[int, ...], list[View]] = {}
    common: dict[tuple[int, ...], View] = {}

    def update_view(raw: np.ndarray) -> View:
        views_of_size = views.setdefault(raw.shape, [])
        if len(views_of_size) < PROBES:
            views_of_size.append(find_view(preprocess, raw))
            common[raw.shape] = combine_views(views_of_size)
        return common[raw.shape]

    return update_view
