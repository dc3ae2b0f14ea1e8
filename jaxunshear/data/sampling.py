"""What a set holds before anything is simulated: poses, taps, slides and splits.

All of it depends on the settings' seed and the stimulus' name alone: adding a stimulus leaves the others as they are. Splits
are of the pose itself (`splits.py`).
"""

import zlib
from typing import NamedTuple

import numpy as np

from jaxunshear.angles import rotate_2d
from jaxunshear.config.configs import compute_config_name, get_set_name
from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.splits import SPLITS, assign_splits
from jaxunshear.config.types import check_rules
from jaxunshear.simulator.scene import (
    Scenes,
    compute_edge_labels,
    make_scenes,
    sample_poses,
    sample_slides,
    sample_tilts,
)

MIN_DEPTH_MM = 0.1  # a tap's jittered depth is raised to this: at or below zero nothing is touched


class ContactSamples(NamedTuple):
    """B contacts, numbered by their row."""

    scenes: Scenes
    pose_id: np.ndarray  # (B,) within the stimulus
    instance: np.ndarray  # (B,) number of the tap or of the slide at its pose
    is_slide: np.ndarray  # (B,) bool: a slide, not a tap
    age: np.ndarray  # (B,) in [0, 1]: when in the session it was recorded
    split: np.ndarray  # (B,) index into `splits.SPLITS`
    edge: (
        np.ndarray
    )  # (B, 2) distance (mm) and direction (deg) of the edge, see `scene.compute_edge_labels`


def check_settings(settings: PairedData | PoseData) -> None:
    """Refuses settings from which no set can be drawn, by name."""
    compute_config_name(settings)
    check_rules(settings, get_set_name(settings))


def _generator(seed: int, stimulus: str, purpose: str) -> np.random.Generator:
    return np.random.default_rng(
        [seed, zlib.crc32(stimulus.encode()), zlib.crc32(purpose.encode())]
    )


def _poses(settings: PairedData | PoseData, stimulus: str) -> np.ndarray:
    ranges = settings.ranges
    depth = (ranges.depth_min_mm, ranges.depth_max_mm)
    generator = _generator(settings.seed, stimulus, "pose")
    poses = sample_poses(generator, settings.poses, ranges.lateral_mm, ranges.yaw_deg, depth)
    if not ranges.tilt_deg:
        return poses
    tilts = sample_tilts(
        _generator(settings.seed, stimulus, "tilt"), settings.poses, ranges.tilt_deg
    )
    return np.concatenate([poses, tilts], axis=1)


def _slides(settings: PairedData, stimulus: str) -> np.ndarray:
    """(poses, slides, 2), or 3 with their twists."""
    ranges, shape = settings.ranges, (settings.poses, settings.slides)
    moves = sample_slides(
        _generator(settings.seed, stimulus, "move"),
        settings.poses * settings.slides,
        ranges.move_mm,
    )
    moves = moves.reshape(*shape, 2)
    if not ranges.twist_deg:
        return moves
    twists = _generator(settings.seed, stimulus, "twist").uniform(
        -ranges.twist_deg, ranges.twist_deg, shape
    )
    return np.concatenate([moves, twists[..., None]], axis=-1)


def _ages(settings: PairedData | PoseData, stimulus: int) -> np.ndarray:
    """(poses,) in [0, 1]: the stimuli take turns, so that wear reveals nothing about the shape."""
    order = np.arange(settings.poses) * len(settings.stimuli) + stimulus
    return order / (settings.poses * len(settings.stimuli) - 1)


def sample_paired(settings: PairedData) -> ContactSamples:
    """For every stimulus and pose `taps` taps, then `slides` slides that end at the pose."""
    check_settings(settings)
    shots = settings.taps + settings.slides
    slid = np.arange(shots) >= settings.taps
    pose, move = [], []
    for name in settings.names:
        poses = np.repeat(_poses(settings, name)[:, None], shots, axis=1)
        jitter = settings.tap_depth_jitter_mm
        depth = poses[:, ~slid, 3]
        deeper = _generator(settings.seed, name, "depth").uniform(-jitter, jitter, depth.shape)
        poses[:, ~slid, 3] = np.maximum(
            depth + deeper, min(MIN_DEPTH_MM, settings.ranges.depth_min_mm)
        )
        leader = find_slide_leaders(settings, name)
        drawn = _slides(settings, name)[leader]
        moves = np.zeros((settings.poses, shots, drawn.shape[-1]))
        yaw = poses[:, 0, 2]
        moves[:, slid] = drawn
        moves[:, slid, :2] = rotate_2d(drawn[..., :2], np.radians(yaw - yaw[leader])[:, None])
        pose.append(poses.reshape(-1, poses.shape[-1]))
        move.append(moves.reshape(-1, moves.shape[-1]))
    each = settings.poses * len(settings.stimuli)
    instance = np.where(slid, np.arange(shots) - settings.taps, np.arange(shots))
    return _shots(
        settings,
        np.concatenate(pose),
        np.concatenate(move),
        np.tile(instance, each),
        np.tile(slid, each),
    )


def find_slide_leaders(settings: PairedData, stimulus: str) -> np.ndarray:
    """(poses,) number of the pose whose slides each pose has: its own, or that of the first of `poses_a_slide` of its split."""
    split = assign_splits(settings.seed, stimulus, settings.poses)
    leader = np.arange(settings.poses)
    for index in range(len(SPLITS)):
        inside = np.flatnonzero(split == index)
        leader[inside] = inside[
            np.arange(len(inside)) // settings.poses_a_slide * settings.poses_a_slide
        ]
    return leader


def sample_taps(settings: PoseData) -> ContactSamples:
    """One tap for every stimulus and pose."""
    check_settings(settings)
    pose = np.concatenate([_poses(settings, name) for name in settings.names])
    zero = np.zeros(len(pose), int)
    return _shots(settings, pose, np.zeros((len(pose), 2)), zero, zero.astype(bool))


def _shots(
    settings: PairedData | PoseData,
    pose: np.ndarray,
    move: np.ndarray,
    instance: np.ndarray,
    slid: np.ndarray,
) -> ContactSamples:
    names = settings.names
    each = len(pose) // (len(names) * settings.poses)
    stimulus = np.repeat(np.arange(len(names)), settings.poses * each)
    pose_id = np.tile(np.repeat(np.arange(settings.poses), each), len(names))
    age = np.concatenate([np.repeat(_ages(settings, index), each) for index in range(len(names))])
    split = np.concatenate(
        [np.repeat(assign_splits(settings.seed, name, settings.poses), each) for name in names]
    )
    scenes = make_scenes(settings.stimuli, stimulus, pose, move, settings.friction)
    return ContactSamples(
        scenes, pose_id, instance, slid, age, split, compute_edge_labels(settings.stimuli, scenes)
    )


def sample_contacts(settings: PairedData | PoseData) -> ContactSamples:
    return sample_paired(settings) if isinstance(settings, PairedData) else sample_taps(settings)
