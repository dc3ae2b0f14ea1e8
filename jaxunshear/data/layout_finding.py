"""Find where the markers of an unknown sensor rest, from its frames (`jaxunshear layout`).

>>> found = find_layout(Path("recordings/untouched"), "pad")
>>> len(found.layout.markers), found.left_out

Markers of one frame are a first layout, against which those of the others are tracked. What few
frames show is dust; what most frames show, and the first does not, is a marker, too.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from jaxunshear.config.sensor import MIN_MARKERS, Preprocess
from jaxunshear.data.recordings import Recordings, read_first_image, read_recordings
from jaxunshear.data.sensor_frame import LARGEST_PX, LATTICE_FRAMES, explain_failure
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import find_neighbours, make_lattice, measure_spacing
from jaxunshear.perception.pin_detection import DetectedPins, detect_pins
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.perception.preprocess import View
from jaxunshear.perception.sensor_check import measure_sensor_appearance
from jaxunshear.results.layout import LayoutFile
from jaxunshear.selection import select_evenly

ROUNDS = 2  # the second tracks markers that the first frame does not show
TRIED_FRAMES = 12  # of which the one that is most like the others is the first
MIN_SEEN_SHARE = 0.5  # of the frames, that show a marker, or that must be understood
SAME_PLACE = 0.3  # of the spacing, within which dots of several frames are one marker
MOVED = 0.15  # of the spacing: markers of untouched frames stand still to well below
MIN_MOVED_SHARE = 0.03  # of the markers, that move where something touches
MIN_MOVED = 3
MIN_REGULAR = 0.5  # share of the markers that stand evenly: dust does not
MAX_NAMED = 8


@dataclass(frozen=True)
class FoundLayout:
    """A layout, and the frames that it is from."""

    layout: LayoutFile
    frames: int
    used: int
    left_out: list[str]  # markers and frames, in a line each, with the reason


def describe_layout(found: FoundLayout) -> list[str]:
    """Describe the layout in lines of text."""
    layout, kind = found.layout, "dark" if found.layout.dark else "light"
    return [
        f"{len(layout.markers)} {kind} markers, {len(layout.neighbours)} pairs of neighbours, "
        f"from {found.used} of {found.frames} frames",
        *(f"note: {each}" for each in found.left_out),
    ]


class _Reading(NamedTuple):
    """The markers of frames that are dark, or light."""

    names: list[str]
    detected: list[DetectedPins]
    view: View
    size: int  # of the prepared images, px
    first: np.ndarray  # (K, 2) px, the dots of the frame that is most like the others


class _Places(NamedTuple):
    """Where N frames show the markers that most of them share."""

    px: np.ndarray  # (N, K, 2); NaN for markers that are not seen, and in frames not understood
    rare: int  # dots that too few frames show

    @property
    def is_understood(self) -> np.ndarray:
        """Which frames (N,) show these markers."""
        return np.isfinite(self.px).any(axis=(1, 2))


def find_layout(path: Path, name: str) -> FoundLayout:
    """Find the layout of the frames at `path`, of an untouched sensor or of taps.

    Raises UserError if they do not show the same markers.
    """
    first = read_first_image(read_recordings(path, Preprocess()).files)
    size = LARGEST_PX if first is None else min(LARGEST_PX, *first.shape[:2])
    recordings = read_recordings(path, Preprocess(size=size))
    rows = select_evenly(len(recordings), LATTICE_FRAMES)
    some = replace(recordings, files=tuple(recordings.files[row] for row in rows))
    readings = [_read(some, dark) for dark in (False, True)]
    reading = max(readings, key=lambda each: (_is_regular(each.first), len(each.first)))
    try:
        return _describe(reading, _find_places(reading), name, some)
    except UserError as error:
        raise explain_failure(error, some.files[0]) from error


def _read(recordings: Recordings, dark: bool) -> _Reading:
    view = recordings.find_common_view(dark=dark)
    if view.box is None:
        next(recordings.iterate_frames(view))  # raises what is wrong with all of them
        raise UserError(f"{recordings.path}: its images differ in size: name those of one camera")
    names, detected = [], []
    for frame in recordings.iterate_frames(view):
        names.append(frame.name)
        detected.append(detect_pins(frame.image))
    first = _choose_first(detected)
    return _Reading(names, detected, view, recordings.preprocess.size, first)


def _is_regular(rest: np.ndarray) -> bool:
    """Say whether dots (K, 2) are enough for a layout, and stand evenly, as dust does not."""
    if len(rest) < MIN_MARKERS:
        return False
    return measure_sensor_appearance(rest, 1).regular >= MIN_REGULAR


def _find_places(reading: _Reading) -> _Places:
    """Find the markers that most frames show; none if there are too few."""
    rest, places = reading.first, _Places(np.zeros((len(reading.detected), 0, 2)), 0)
    for _ in range(ROUNDS):
        if len(rest) < MIN_MARKERS:
            break
        places = _track(rest, reading.detected)
        rest = np.nanmedian(places.px[places.is_understood], axis=0)
    return places


def _choose_first(detected: list[DetectedPins]) -> np.ndarray:
    """Choose the dots (K, 2) px of the frame that is most like the others."""
    tried = [detected[row].pins for row in select_evenly(len(detected), TRIED_FRAMES)]

    def count_alike(pins: np.ndarray) -> float:
        if len(pins) < MIN_MARKERS:
            return 0.0
        tree, limit = cKDTree(pins), SAME_PLACE * measure_spacing(pins)
        return float(np.median([np.sum(tree.query(other)[0] < limit) for other in tried]))

    return max(tried, key=count_alike)


def _track(rest: np.ndarray, detected: list[DetectedPins]) -> _Places:
    """Track markers (K, 2) px in all frames, and find those that most of the frames show."""
    lattice = make_lattice(rest)
    tracks = track_all(lattice, detected)
    rows = [row for row, track in enumerate(tracks) if track.identified]
    home = [np.zeros((0, 2))]  # where dots would stand if nothing had moved
    for row in rows:
        motion = lattice.fill_missing(tracks[row].motion)
        nearest = cKDTree(rest + motion).query(detected[row].pins)[1]
        home.append(detected[row].pins - motion[nearest])
    frame = np.repeat(rows, [len(each) for each in home[1:]]).astype(int)
    marker = _cluster(np.concatenate(home), SAME_PLACE * lattice.spacing)
    px = np.full((len(detected), marker.max(initial=-1) + 1, 2), np.nan)
    px[frame, marker] = np.concatenate([np.zeros((0, 2)), *(detected[row].pins for row in rows)])
    is_seen = np.isfinite(px[..., 0]).sum(axis=0) >= MIN_SEEN_SHARE * len(rows)
    return _Places(px[:, is_seen], int(np.sum(~is_seen)))


def _cluster(points: np.ndarray, limit: float) -> np.ndarray:
    """Return the number of the cluster of each point (N, 2): those within `limit` are in one."""
    pairs = cKDTree(points).query_pairs(limit, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    clusters: np.ndarray = connected_components(links, directed=False)[1]
    return clusters


def _describe(reading: _Reading, places: _Places, name: str, recordings: Recordings) -> FoundLayout:
    """Describe the markers of the frames that are understood. Raises UserError."""
    (frames, count), used = places.px.shape[:2], places.is_understood
    if count < MIN_MARKERS or np.mean(used) < MIN_SEEN_SHARE:
        raise UserError(
            f"{recordings.path}: {np.sum(used)} of {frames} frames show the same {count} markers: "
            f"half of them, and {MIN_MARKERS} markers, are needed; light and focus the markers, "
            "and name frames of one camera"
        )
    left_out = list(recordings.notes)
    left_out += _name_frames(reading, ~used, "other markers than the rest shows")
    is_touched = used & _find_contact_frames(places.px)
    if np.sum(is_touched) > MIN_SEEN_SHARE * np.sum(used):
        left_out.append(
            f"markers move in {np.sum(is_touched)} of {frames} frames: places are means over "
            "contacts; frames of the untouched sensor are better"
        )
    else:
        left_out += _name_frames(reading, is_touched, "something touches the sensor")
        used = used & ~is_touched
    is_known = np.isfinite(places.px[used]).any(axis=(0, 2))
    rest = np.nanmean(places.px[used][:, is_known], axis=0)
    if not _is_regular(rest):
        raise UserError(f"{recordings.path}: its dots are scattered: they are no layout of markers")
    if places.rare:
        dots = f"{places.rare} dot{'s' if places.rare > 1 else ''}"
        left_out.append(f"left out {dots}: fewer than half of the frames show them")
    return FoundLayout(_make_file(reading, rest, name), frames, int(np.sum(used)), left_out)


def _find_contact_frames(px: np.ndarray) -> np.ndarray:
    """Find the frames (N,) in which some markers have moved, against the others."""
    motion = px - np.nanmedian(px, axis=0)
    spacing = measure_spacing(np.nanmedian(px, axis=0))
    is_touched = np.zeros(len(px), bool)
    for row in np.flatnonzero(np.isfinite(px).any(axis=(1, 2))):
        moved = np.linalg.norm(motion[row] - np.nanmedian(motion[row], axis=0), axis=-1)
        limit = max(MIN_MOVED, MIN_MOVED_SHARE * px.shape[1])
        is_touched[row] = np.sum(moved > MOVED * spacing) >= limit
    return is_touched


def _name_frames(reading: _Reading, chosen: np.ndarray, reason: str) -> list[str]:
    names = [reading.names[row] for row in np.flatnonzero(chosen)]
    if not names:
        return []
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    count = f"{len(names)} frame{'s' if len(names) > 1 else ''}"
    return [f"left out {count}: {reason}: {', '.join(names[:MAX_NAMED])}{more}"]


def _make_file(reading: _Reading, rest: np.ndarray, name: str) -> LayoutFile:
    """Make the file of markers (P, 2) px of the prepared image, row by row."""
    box, frame_px = reading.view.box, reading.view.frame_px
    assert box is not None and frame_px is not None
    rest = rest[np.lexsort((rest[:, 0], np.round(rest[:, 1] / measure_spacing(rest))))]
    height, width = frame_px
    shorter, scale = min(frame_px), (box.right - box.left) / reading.size
    corner = np.array([box.left - width / 2, box.top - height / 2])
    markers = (corner + (rest + 0.5) * scale) / shorter
    radius = float(np.median([each.radius for each in reading.detected])) * scale / shorter
    return LayoutFile(
        name=name,
        image_px=(width, height),
        dark=reading.view.dark,
        marker_radius=round(radius, 5),
        markers=tuple((round(x, 5), round(y, 5)) for x, y in markers.tolist()),
        neighbours=tuple((a, b) for a, b in find_neighbours(rest).tolist()),
    )
