"""Pair recorded slides with taps: recorded ones, or drawn ones in their place.

pairs = pair_with_taps(slides, taps, targets, "nearest")
pairs = pair_with_renderings(slides, targets, render)  # pins; with `taps` and `warp` images too

Slides and taps are rows by field, as `RecordedSet` selects them. Pairs have the slides' fields, and
`canonical` and `canonical_pins` of the tap, `gap` (N, 6), by which the tap's pose differs, and
`weight` (N,), what a pair counts in training.
"""

from collections.abc import Callable

import numpy as np
from scipy import ndimage
from scipy.spatial import Delaunay, cKDTree

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.targets import RECORDED_FIELDS, Targets
from jaxunshear.data.chunks import unpack_bits
from jaxunshear.data.reader import Batch
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.triangles import find_corners

# Of the pins' spacing: how far beyond the outermost pins an image moves with them.
MAX_OUTSIDE_SPACINGS = 0.75
SAME_POSE = 1e-3  # mm and deg: labels of one `pose_id` that differ by more are of different poses

TapRenderer = Callable[[np.ndarray], np.ndarray]  # poses (N, 6) -> pins (N, P, 2) px
# images (N, S, S), or None if the estimator takes pins; pins (N, P, 2) px -> poses (N, 6)
PoseEstimator = Callable[[np.ndarray | None, np.ndarray], np.ndarray]
# split -> row (N,) of a labelled tap, sheared_pins (N, P, 2) px and move (N, 6): simulated slides
SlideSimulator = Callable[[str], Batch]
# images (N, bytes) at one bit a pixel, motions (N, P, 2) px of their pins -> (N, S, S) uint8
ImageWarper = Callable[[np.ndarray, np.ndarray], np.ndarray]


def take_rows(rows: Batch, selected: np.ndarray | np.bool | slice) -> Batch:
    """Take some rows of each field."""
    return {name: value[selected] for name, value in rows.items()}


def make_pose_ids_unique(rows: Batch) -> Batch:
    """Give each contact its own `pose_id`.

    So `Reader.train_batches`, which draws a tap of the same `pose_id`, keeps this pairing.
    """
    return rows | {"pose_id": rows["number"]}


def pair_with_taps(slides: Batch, taps: Batch, targets: Targets, method: str) -> Batch:
    """Pair slides with the tap of the "nearest" pose by `targets`, or of the same `pose_id`.

    "pose_id" requires the same pose, too; "file" does not. Slides without such a tap are left out.
    """
    if method == "nearest":
        row, distance = find_nearest(targets, slides["pose"], taps["pose"])
        weight = compute_pair_weights(distance)
    else:
        row = match_same_pose(slides, taps, checked=method == "pose_id")
        slides, row = take_rows(slides, row >= 0), row[row >= 0]
        weight = np.ones(len(row), np.float32)
    pairs = slides | {
        "canonical": taps["image"][row],
        "canonical_pins": taps["pins"][row],
        "gap": compute_pose_gaps(slides["pose"], taps["pose"][row]).astype(np.float32),
        "weight": weight,
    }
    return make_pose_ids_unique(pairs) if method == "nearest" else pairs


def pair_with_renderings(
    slides: Batch,
    targets: Targets,
    render: TapRenderer,
    taps: Batch | None = None,
    warp: ImageWarper | None = None,
) -> Batch:
    """Pair slides with the pins that a renderer puts at their pose.

    With `taps` and `warp` there are images, too: of the nearest tap, its pins moved to where the
    renderer puts them. So they have real dots and the real housing, as the taps that a PoseNet
    learnt from; to such a network dots drawn anew appear foreign.
    """
    pins = render(slides["pose"]).astype(np.float32)
    partner = {"canonical_pins": pins}
    if taps is not None and warp is not None:
        row, _ = find_nearest(targets, slides["pose"], taps["pose"])
        partner["canonical"] = warp(taps["image"][row], pins - render(taps["pose"][row]))
    return make_pose_ids_unique(slides | partner | make_full_pairs(len(pins)))


def make_full_pairs(count: int) -> Batch:
    """Make `gap` and `weight` of slides whose partners have their very pose."""
    return {"gap": np.zeros((count, 6), np.float32), "weight": np.ones(count, np.float32)}


def compute_pose_gaps(slides: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Return absolute differences of poses (N, 6), angles the short way round."""
    difference = taps - np.asarray(slides, np.float64)
    is_angle = np.array([name.endswith("_deg") for name in RECORDED_FIELDS])
    return np.abs(np.where(is_angle, wrap_degrees(difference), difference))


def find_nearest(
    targets: Targets, slides: np.ndarray, taps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find for each slide's pose (N, 6) the row of the nearest tap's (M, 6), and their distance.

    Distances (N,) are in units of the targets' ranges.
    """
    distance, rows = cKDTree(_scale_poses(targets, taps)).query(_scale_poses(targets, slides))
    return rows, distance


def _scale_poses(targets: Targets, poses: np.ndarray) -> np.ndarray:
    return np.concatenate([target.scale(poses[:, target.column]) for target in targets], axis=1)


def compute_pair_weights(distance: np.ndarray) -> np.ndarray:
    """Return weights (N,) of pairs by the gap between their poses: half at its median, mean 1."""
    weight = 2.0 ** -np.square(distance / max(float(np.median(distance)), 1e-9))
    return (weight / weight.mean()).astype(np.float32)


def match_same_pose(slides: Batch, taps: Batch, checked: bool) -> np.ndarray:
    """Return for each slide the row (N,) of a tap of the same `pose_id`; -1 if there is none.

    If `checked`, the poses must be the same, too. The slides of a pose take its taps in turn.
    """
    rows_by_id: dict[int, list[int]] = {}
    for row, pose_id in enumerate(taps["pose_id"].tolist()):
        if pose_id >= 0:
            rows_by_id.setdefault(pose_id, []).append(row)
    turns: dict[int, int] = {}
    matches = np.full(len(slides["pose_id"]), -1)
    for row, pose_id in enumerate(slides["pose_id"].tolist()):
        candidates = np.array(rows_by_id.get(pose_id, []), int)
        if checked and len(candidates):
            gaps = compute_pose_gaps(slides["pose"][row], taps["pose"][candidates])
            candidates = candidates[gaps.max(axis=1) <= SAME_POSE]
        if len(candidates):
            turn = turns.get(pose_id, 0)
            matches[row], turns[pose_id] = candidates[turn % len(candidates)], turn + 1
    return matches


def find_recorded_taps(contacts: RecordedContacts, slides: np.ndarray) -> np.ndarray:
    """Find the taps (N,) that were recorded at the poses of slides (N,), -1 where there is none."""
    taps = np.flatnonzero(~contacts.is_slide)
    labels = {"pose": contacts.pose, "pose_id": contacts.pose_id}
    found = match_same_pose(take_rows(labels, slides), take_rows(labels, taps), checked=True)
    return np.where(found >= 0, np.append(taps, -1)[found], -1)


def make_image_warper(rest: np.ndarray, spacing_px: float, size: int) -> ImageWarper:
    """Make a function that warps images of `size` px so that their pins move as they are to.

    Pins rest at `rest` (P, 2) px (column, row). Pixels move linearly between three pins, and not
    at all beyond the outermost ones. The edges of pins become grey, which shows fractions of a
    pixel.
    """
    rows, columns = np.mgrid[:size, :size].astype(np.float32)
    pins, weights = _interpolate_over_pixels(rest, spacing_px, size)

    def warp(images: np.ndarray, motions: np.ndarray) -> np.ndarray:
        unpacked = unpack_bits(images, size)
        warped = np.empty_like(unpacked)
        for i, image in enumerate(unpacked):
            pin_motion = motions[i].astype(np.float32)[pins]
            shift = (pin_motion * weights[..., None]).sum(axis=1).reshape(size, size, 2)
            sources = [rows - shift[..., 1], columns - shift[..., 0]]
            warped[i] = ndimage.map_coordinates(image, sources, np.uint8, order=1, mode="nearest")
        return warped

    return warp


def _interpolate_over_pixels(
    rest: np.ndarray, spacing_px: float, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find the pins (S S, 3) whose motions give a pixel's, and their weights."""
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1)
    pixels = grid.reshape(-1, 2).astype(float)
    pins, weights, is_outside = find_corners(Delaunay(rest), pixels)
    distance, _ = cKDTree(rest).query(pixels)
    weights[is_outside & (distance > MAX_OUTSIDE_SPACINGS * spacing_px)] = 0
    return pins, weights.astype(np.float32)
