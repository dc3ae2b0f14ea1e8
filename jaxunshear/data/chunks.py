"""Files of contacts, a chunk each, and the examples that the simulated sets make of them.

samples = sample_contacts(settings)
paths = simulate_chunks(settings, sensor, samples, folder, make_engine())
for key, example in iterate_paired_examples(settings, samples, paths, "train"): ...
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.sampling import ContactSamples
from jaxunshear.errors import UserError
from jaxunshear.files import BROKEN_NPZ, Json, read_npz, write_npz
from jaxunshear.perception.drawing import encode_png
from jaxunshear.progress import Progress
from jaxunshear.selection import number_poses

CONTACT_COUNTS = ("stuck", "slipping", "free", "iterations")
PNG_LEVEL = 4

Chunk = dict[str, np.ndarray]


def load_chunk(path: Path) -> Chunk:
    """Load a chunk's fields. Raises UserError for a damaged file."""
    try:
        return read_npz(path)
    except BROKEN_NPZ as error:
        raise UserError(
            f"chunk {path} cannot be read ({error}): delete it and run the same command again"
        ) from error


def join_field(chunks: Iterable[Chunk], name: str) -> np.ndarray:
    return np.concatenate([chunk[name] for chunk in chunks])


def write_chunks(
    folder: Path,
    parts: Sequence[np.ndarray],
    make: Callable[[list[int]], Iterable[tuple[int, Chunk]]],
    label: str,
) -> list[Path]:
    """Write a file for each part, rows of contacts; files of these rows are kept, returns all.

    `make` yields the chunks of the parts of these indices with their index, in any order. The
    field `number` of a chunk has its rows.
    """
    paths = [folder / f"{index:05d}.npz" for index in range(len(parts))]
    missing = [index for index, path in enumerate(paths) if not _holds_rows(path, parts[index])]
    if not missing:
        return paths
    count = sum(map(len, parts))
    done = count - sum(len(parts[index]) for index in missing)
    with Progress(label, count, "contacts", done=done) as progress:
        for index, chunk in make(missing):
            write_npz(paths[index], chunk)
            progress.advance(len(parts[index]))
    return paths


def _holds_rows(path: Path, rows: np.ndarray) -> bool:
    """Say whether a file has these rows; a killed run of another version may have left others."""
    return path.exists() and np.array_equal(load_chunk(path).get("number", ()), rows)


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


def pack_bits(images: np.ndarray) -> np.ndarray:
    """Pack binary images (B, S, S) to (B, bytes), one bit a pixel."""
    return np.packbits(images.reshape(len(images), -1) > 0, axis=-1)


def unpack_bits(bits: np.ndarray, size: int) -> np.ndarray:
    """Unpack (..., bytes) to images (..., S, S) uint8 in {0, 255}."""
    pixels = np.unpackbits(bits, axis=-1, count=size * size)
    return pixels.reshape(*bits.shape[:-1], size, size) * np.uint8(255)


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
        pose = number_poses(samples.scenes.stimulus, samples.pose_id)
        written = slides & np.isin(pose, pose[usable & ~samples.is_slide])
        unpaired = int(slides.sum() - written.sum())
    dropped = []
    for row in np.flatnonzero(~usable).tolist():
        dropped.append(
            {
                "number": row,
                "stimulus": settings.names[samples.scenes.stimulus[row]],
                "pose_id": int(samples.pose_id[row]),
                "pose": samples.scenes.pose[row].tolist(),
                "move": samples.scenes.move[row].tolist(),
            }
        )
    return {
        "contacts": len(samples.scenes),
        "retried": retried,
        "dropped": len(dropped),
        "iterations": {
            "median": float(np.median(iterations)),
            "most": int(iterations.max()),
            "slowest_number": int(iterations.argmax()),
        },
        "slides_without_tap": unpaired,
        "written": count_by_split(samples.split, written),
        "dropped_scenes": dropped,
    }


def count_by_split(split: np.ndarray, selected: np.ndarray) -> dict[str, int]:
    """Count the `selected` (N,) bool of contacts by their split (N,), an index into SPLITS."""
    counts = np.bincount(split[selected], minlength=len(SPLITS))
    return dict(zip(SPLITS, counts.tolist(), strict=True))


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
    pose = number_poses(samples.scenes.stimulus, samples.pose_id)
    taps, taps_by_pose = dict[int, Json](), dict[int, list[int]]()
    for tap in iterate_usable_rows(paths, in_split & ~samples.is_slide):
        taps[tap.row] = {"image": tap.encode_png(size), "pins": tap.get("pins")}
    for row in sorted(taps):
        taps_by_pose.setdefault(pose[row], []).append(row)
    for slide in iterate_usable_rows(paths, in_split & samples.is_slide):
        row = slide.row
        if pose[row] not in taps_by_pose:
            continue
        slide_id, partners = int(samples.instance[row]), taps_by_pose[pose[row]]
        partner = partners[slide_id % len(partners)]
        labels = _make_labels(settings, samples, row)
        example = {
            "canonical": taps[partner]["image"],
            "sheared": slide.encode_png(size),
            "canonical_pins": taps[partner]["pins"],
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
