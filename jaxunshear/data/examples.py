"""Chunks of contacts -> examples of the two data sets, and the counts that go with a set.

shots = draw(settings)                                                    # data/sampling.py
paths = simulate_chunks(settings, sensor, shots, folder, simulator())     # data/chunks.py
for key, example in paired_examples(settings, shots, paths, "train"): ...
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import encode_stored_png, iterate_usable_rows, load_chunk
from jaxunshear.data.sampling import ContactSamples
from jaxunshear.files import Json


def summarise_set(
    settings: PairedData | PoseData, samples: ContactSamples, paths: list[Path]
) -> dict:
    """Counts of a set, and the scene of every contact that was dropped (plain JSON types)."""
    usable = np.zeros(len(samples.scenes), bool)
    iterations = np.zeros(len(samples.scenes), int)
    retried = 0
    for path in paths:
        chunk = load_chunk(path)
        usable[chunk["number"]] = chunk["usable"]
        iterations[chunk["number"]] = chunk["iterations"]
        retried += int(chunk["retried"].sum())
    written = usable & samples.is_slide if isinstance(settings, PairedData) else usable
    unpaired = 0
    if isinstance(settings, PairedData):
        taps = _by_pose(samples, np.flatnonzero(usable & ~samples.is_slide))
        alone = np.array([not taps.get(key) for key in _pose_keys(samples)])
        unpaired = int((written & alone).sum())
        written &= ~alone
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
            {
                "number": int(row),
                "stimulus": settings.names[samples.scenes.stimulus[row]],
                "pose_id": int(samples.pose_id[row]),
                "pose": samples.scenes.pose[row].tolist(),
                "move": samples.scenes.move[row].tolist(),
            }
            for row in np.flatnonzero(~usable)
        ],
    }


def _pose_keys(shots: ContactSamples) -> list[tuple[int, int]]:
    return list(zip(shots.scenes.stimulus.tolist(), shots.pose_id.tolist(), strict=True))


def _by_pose(shots: ContactSamples, rows: np.ndarray) -> dict[tuple[int, int], list[int]]:
    keys = _pose_keys(shots)
    groups: dict[tuple[int, int], list[int]] = {}
    for row in rows.tolist():
        groups.setdefault(keys[row], []).append(row)
    return groups


def _labels(settings: PairedData | PoseData, shots: ContactSamples, row: int) -> Json:
    return {
        "pose": shots.scenes.pose[row].astype(np.float32),
        "edge": shots.edge[row].astype(np.float32),
        "stimulus": settings.names[shots.scenes.stimulus[row]],
        "pose_id": int(shots.pose_id[row]),
    }


def iterate_paired_examples(
    settings: PairedData, shots: ContactSamples, paths: list[Path], split: str
) -> Iterator[tuple[str, dict]]:
    """(key, example) of every usable slide of a split with a tap of its pose: slide j takes tap j modulo their number."""
    inside = shots.split == SPLITS.index(split)
    tap_images, tap_pins = {}, {}
    for chunk, place, row in iterate_usable_rows(paths, inside & ~shots.is_slide):
        tap_images[row] = encode_stored_png(chunk, place, settings.preprocess.size)
        tap_pins[row] = chunk["pins"][place]
    taps = _by_pose(shots, np.array(sorted(tap_images), int))
    keys = _pose_keys(shots)
    for chunk, place, row in iterate_usable_rows(paths, inside & shots.is_slide):
        if keys[row] not in taps:
            continue
        slide = int(shots.instance[row])
        tap = taps[keys[row]][slide % len(taps[keys[row]])]
        labels = _labels(settings, shots, row)
        yield (
            f"{labels['stimulus']}_{labels['pose_id']}_{slide}",
            {
                "canonical": tap_images[tap],
                "sheared": encode_stored_png(chunk, place, settings.preprocess.size),
                "canonical_pins": tap_pins[tap],
                "sheared_pins": chunk["pins"][place],
                **labels,
                "move": shots.scenes.move[row].astype(np.float32),
                "friction": np.float32(shots.scenes.friction[row]),
                "slide_id": slide,
                "tap_id": int(shots.instance[tap]),
                "tap_depth_mm": np.float32(shots.scenes.pose[tap, 3]),
                "residual_mm": np.float32(chunk["residual_mm"][place]),
                **{
                    name: int(chunk[name][place])
                    for name in ("stuck", "slipping", "free", "iterations")
                },
            },
        )


def iterate_pose_examples(
    settings: PoseData, shots: ContactSamples, paths: list[Path], split: str
) -> Iterator[tuple[str, dict]]:
    """(key, example) of every usable tap of a split."""
    inside = shots.split == SPLITS.index(split)
    for chunk, place, row in iterate_usable_rows(paths, inside):
        labels = _labels(settings, shots, row)
        yield (
            f"{labels['stimulus']}_{labels['pose_id']}",
            {
                "image": encode_stored_png(chunk, place, settings.preprocess.size),
                "pins": chunk["pins"][place],
                **labels,
                "residual_mm": np.float32(chunk["residual_mm"][place]),
                "age": np.float32(shots.age[row]),
            },
        )
