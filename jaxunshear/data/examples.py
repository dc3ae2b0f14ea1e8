"""Turn chunks of contacts into examples of the two simulated data sets, and count them.

samples = sample_contacts(settings)
paths = simulate_chunks(settings, sensor, samples, folder, make_engine())
for key, example in iterate_paired_examples(settings, samples, paths, "train"): ...
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import iterate_usable_rows, load_chunk
from jaxunshear.data.sampling import ContactSamples
from jaxunshear.files import Json

CONTACT_COUNTS = ("stuck", "slipping", "free", "iterations")


def summarise_set(
    settings: PairedData | PoseData, samples: ContactSamples, paths: list[Path]
) -> dict:
    """Count the contacts of a set, and list the scenes of those that were dropped.

    All values are plain JSON types.
    """
    usable = np.zeros(len(samples.scenes), bool)
    iterations = np.zeros(len(samples.scenes), int)
    retried = 0
    for path in paths:
        chunk = load_chunk(path)
        usable[chunk["number"]] = chunk["usable"]
        iterations[chunk["number"]] = chunk["iterations"]
        retried += int(chunk["retried"].sum())
    written, unpaired = usable, 0
    if samples.is_slide.any():
        slides = usable & samples.is_slide
        written = slides & _has_tap(samples, usable)
        unpaired = int(slides.sum() - written.sum())
    return {
        "contacts": len(samples.scenes),
        "retried": retried,
        "dropped": int((~usable).sum()),
        "iterations": {
            "median": float(np.median(iterations)),
            "most": int(iterations.max()),
            "slowest_number": int(iterations.argmax()),
        },
        "slides_without_tap": unpaired,
        "written": {
            name: int((written & (samples.split == index)).sum())
            for index, name in enumerate(SPLITS)
        },
        "dropped_scenes": [
            _describe_scene(settings, samples, int(row)) for row in np.flatnonzero(~usable)
        ],
    }


def _describe_scene(settings: PairedData | PoseData, samples: ContactSamples, row: int) -> Json:
    return {
        "number": row,
        "stimulus": settings.names[samples.scenes.stimulus[row]],
        "pose_id": int(samples.pose_id[row]),
        "pose": samples.scenes.pose[row].tolist(),
        "move": samples.scenes.move[row].tolist(),
    }


class _PoseKey(NamedTuple):
    stimulus: int
    pose_id: int


def _list_pose_keys(samples: ContactSamples) -> list[_PoseKey]:
    pairs = zip(samples.scenes.stimulus.tolist(), samples.pose_id.tolist(), strict=True)
    return [_PoseKey(*pair) for pair in pairs]


def _group_by_pose(samples: ContactSamples, rows: np.ndarray) -> dict[_PoseKey, list[int]]:
    keys = _list_pose_keys(samples)
    groups: dict[_PoseKey, list[int]] = {}
    for row in rows.tolist():
        groups.setdefault(keys[row], []).append(row)
    return groups


def _has_tap(samples: ContactSamples, usable: np.ndarray) -> np.ndarray:
    """Return for each contact (N,) whether there is a usable tap at its pose."""
    taps = _group_by_pose(samples, np.flatnonzero(usable & ~samples.is_slide))
    return np.array([key in taps for key in _list_pose_keys(samples)])


def _make_labels(settings: PairedData | PoseData, samples: ContactSamples, row: int) -> Json:
    return {
        "pose": samples.scenes.pose[row].astype(np.float32),
        "edge": samples.edge[row].astype(np.float32),
        "stimulus": settings.names[samples.scenes.stimulus[row]],
        "pose_id": int(samples.pose_id[row]),
    }


def iterate_paired_examples(
    settings: PairedData, samples: ContactSamples, paths: list[Path], split: str
) -> Iterator[tuple[str, dict]]:
    """Iterate over (key, example) of every usable slide of a split with a tap of its pose.

    Slide j takes tap j modulo the number of taps.
    """
    size, in_split = settings.preprocess.size, samples.split == SPLITS.index(split)
    tap_images, tap_pins = {}, {}
    for tap in iterate_usable_rows(paths, in_split & ~samples.is_slide):
        tap_images[tap.row] = tap.encode_png(size)
        tap_pins[tap.row] = tap.get("pins")
    taps = _group_by_pose(samples, np.array(sorted(tap_images), int))
    keys = _list_pose_keys(samples)
    for slide in iterate_usable_rows(paths, in_split & samples.is_slide):
        row = slide.row
        if keys[row] not in taps:
            continue
        slide_id, partners = int(samples.instance[row]), taps[keys[row]]
        partner = partners[slide_id % len(partners)]
        labels = _make_labels(settings, samples, row)
        example = {
            "canonical": tap_images[partner],
            "sheared": slide.encode_png(size),
            "canonical_pins": tap_pins[partner],
            "sheared_pins": slide.get("pins"),
            **labels,
            "move": samples.scenes.move[row].astype(np.float32),
            "friction": np.float32(samples.scenes.friction[row]),
            "slide_id": slide_id,
            "tap_id": int(samples.instance[partner]),
            "tap_depth_mm": np.float32(samples.scenes.pose[partner, 3]),
            "residual_mm": np.float32(slide.get("residual_mm")),
            **{name: int(slide.get(name)) for name in CONTACT_COUNTS},
        }
        yield f"{labels['stimulus']}_{labels['pose_id']}_{slide_id}", example


def iterate_pose_examples(
    settings: PoseData, samples: ContactSamples, paths: list[Path], split: str
) -> Iterator[tuple[str, dict]]:
    """Iterate over (key, example) of every usable tap of a split."""
    in_split = samples.split == SPLITS.index(split)
    for tap in iterate_usable_rows(paths, in_split):
        labels = _make_labels(settings, samples, tap.row)
        example = {
            "image": tap.encode_png(settings.preprocess.size),
            "pins": tap.get("pins"),
            **labels,
            "residual_mm": np.float32(tap.get("residual_mm")),
            "age": np.float32(samples.age[tap.row]),
        }
        yield f"{labels['stimulus']}_{labels['pose_id']}", example
