"""Sample what a set holds before anything is simulated: poses, taps, slides and splits.

All of it depends on the settings' seed and the stimulus' name alone, so that a further stimulus
leaves the others as they are. Splits are of the pose itself (`splits.py`).
"""

import zlib
from typing import NamedTuple

import numpy as np

from jaxunshear.angles import rotate_2d
from jaxunshear.config.configs import compute_config_name
from jaxunshear.config.data import DataSettings, PairedData, PoseData
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.config.splits import SPLITS, assign_splits
from jaxunshear.config.types import raise_first_problem
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
    edge: np.ndarray  # (B, 2) mm to the edge and its direction, deg (`scene.compute_edge_labels`)


def check_settings(settings: DataSettings, sensor: Sensor = TACTIP_331) -> None:
    """Raise UserError, by field, for settings from which no set can be made."""
    compute_config_name(settings, sensor)
    raise_first_problem(settings, settings.set_name)


def _make_generator(seed: int, stimulus: str, purpose: str) -> np.random.Generator:
    return np.random.default_rng(
        [seed, zlib.crc32(stimulus.encode()), zlib.crc32(purpose.encode())]
    )


def _sample_poses(settings: PairedData | PoseData, stimulus: str) -> np.ndarray:
    """Sample (poses, 4), or 6 with their tilts."""
    ranges = settings.ranges
    depth = (ranges.depth_min_mm, ranges.depth_max_mm)
    generator = _make_generator(settings.seed, stimulus, "pose")
    poses = sample_poses(generator, settings.poses, ranges.lateral_mm, ranges.yaw_deg, depth)
    if not ranges.tilt_deg:
        return poses
    generator = _make_generator(settings.seed, stimulus, "tilt")
    tilts = sample_tilts(generator, settings.poses, ranges.tilt_deg)
    return np.concatenate([poses, tilts], axis=1)


def sample_pairs(settings: PairedData) -> ContactSamples:
    """Sample for every stimulus and pose `taps` taps, then `slides` slides that end at the pose."""
    check_settings(settings)
    contacts = settings.taps + settings.slides  # of a pose
    is_slide = np.arange(contacts) >= settings.taps
    pose, move = [], []
    for name in settings.names:
        poses = np.repeat(_sample_poses(settings, name)[:, None], contacts, axis=1)
        depth, jitter = poses[:, ~is_slide, 3], settings.tap_depth_jitter_mm
        depth += _make_generator(settings.seed, name, "depth").uniform(-jitter, jitter, depth.shape)
        least = min(MIN_DEPTH_MM, settings.ranges.depth_min_mm)
        poses[:, ~is_slide, 3] = np.maximum(depth, least)
        moves = _sample_moves(settings, name, yaw=poses[:, 0, 2])
        still = np.zeros((settings.poses, settings.taps, moves.shape[-1]))
        pose.append(poses.reshape(-1, poses.shape[-1]))
        move.append(np.concatenate([still, moves], axis=1).reshape(-1, moves.shape[-1]))
    repeats = settings.poses * len(settings.stimuli)
    instance = np.where(is_slide, np.arange(contacts) - settings.taps, np.arange(contacts))
    return _make_samples(
        settings,
        np.concatenate(pose),
        np.concatenate(move),
        np.tile(instance, repeats),
        np.tile(is_slide, repeats),
    )


def _sample_moves(settings: PairedData, stimulus: str, yaw: np.ndarray) -> np.ndarray:
    """Sample the moves (poses, slides, 2 or 3) of slides that end at poses of this yaw deg.

    Poses with the same leader share their moves in the sensor frame.
    """
    ranges, shape = settings.ranges, (settings.poses, settings.slides)
    generator = _make_generator(settings.seed, stimulus, "move")
    moves = sample_slides(generator, settings.poses * settings.slides, ranges.move_mm)
    leader = find_slide_leaders(settings, stimulus)
    turn = np.radians(yaw - yaw[leader])[:, None]
    moves = rotate_2d(moves.reshape(*shape, 2)[leader], turn)
    if not ranges.twist_deg:
        return moves
    generator = _make_generator(settings.seed, stimulus, "twist")
    twists = generator.uniform(-ranges.twist_deg, ranges.twist_deg, shape)[leader]
    return np.concatenate([moves, twists[..., None]], axis=-1)


def find_slide_leaders(settings: PairedData, stimulus: str) -> np.ndarray:
    """Find for each pose (poses,) the number of the pose whose slides it has.

    It is the first of `poses_a_slide` poses of its split.
    """
    split = assign_splits(settings.seed, stimulus, settings.poses)
    leader = np.arange(settings.poses)
    for index in range(len(SPLITS)):
        members = np.flatnonzero(split == index)
        rank = np.arange(len(members))
        leader[members] = members[rank // settings.poses_a_slide * settings.poses_a_slide]
    return leader


def sample_taps(settings: PoseData) -> ContactSamples:
    """Sample one tap for every stimulus and pose."""
    check_settings(settings)
    pose = np.concatenate([_sample_poses(settings, name) for name in settings.names])
    zero = np.zeros(len(pose), int)
    return _make_samples(settings, pose, np.zeros((len(pose), 2)), zero, zero.astype(bool))


def _make_samples(
    settings: PairedData | PoseData,
    pose: np.ndarray,
    move: np.ndarray,
    instance: np.ndarray,
    is_slide: np.ndarray,
) -> ContactSamples:
    """Complete contacts (B,) that are ordered by stimulus, then by pose."""
    names = settings.names
    repeats = len(pose) // (len(names) * settings.poses)  # contacts of a pose
    stimulus = np.repeat(np.arange(len(names)), settings.poses * repeats)
    pose_id = np.tile(np.repeat(np.arange(settings.poses), repeats), len(names))
    # stimuli take turns, so that wear does not reveal the shape
    order = np.arange(settings.poses) * len(names) + np.arange(len(names))[:, None]
    ages = order.ravel() / (order.size - 1)
    splits = [assign_splits(settings.seed, name, settings.poses) for name in names]
    scenes = make_scenes(settings.stimuli, stimulus, pose, move, settings.friction)
    return ContactSamples(
        scenes=scenes,
        pose_id=pose_id,
        instance=instance,
        is_slide=is_slide,
        age=np.repeat(ages, repeats),
        split=np.repeat(np.concatenate(splits), repeats),
        edge=compute_edge_labels(settings.stimuli, scenes),
    )


def sample_contacts(settings: PairedData | PoseData) -> ContactSamples:
    """Sample the contacts of a paired set, or the taps of a pose set."""
    return sample_pairs(settings) if isinstance(settings, PairedData) else sample_taps(settings)
