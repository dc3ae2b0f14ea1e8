import dataclasses

import numpy as np
import pytest

from jaxunshear.config.configs import (
    PAIRED,
    POSE,
    compute_config_name,
    compute_fingerprint,
    get_config_sensor,
)
from jaxunshear.config.data import PairedData, PoseData, Ranges
from jaxunshear.config.sensor import FITTED_CAMERA, FITTED_FRICTION, TACTIP_127, TACTIP_331_FITTED
from jaxunshear.config.splits import SPLITS, assign_split
from jaxunshear.data.sampling import MIN_DEPTH_MM, sample_pairs, sample_taps
from jaxunshear.errors import UserError


def test_every_pose_has_its_taps_and_slides_in_one_split(paired):
    shots = sample_pairs(paired)
    assert len(shots.scenes) == 2 * 10 * 5
    for stimulus in range(2):
        for pose_id in range(10):
            here = (shots.scenes.stimulus == stimulus) & (shots.pose_id == pose_id)
            instances = sorted(zip(shots.is_slide[here], shots.instance[here], strict=True))
            assert instances == [(0, 0), (0, 1), (1, 0), (1, 1), (1, 2)]
            assert len(set(shots.split[here])) == 1
            assert np.ptp(shots.age[here]) == 0  # a tap and its slides drift alike
            assert np.ptp(shots.scenes.pose[here], axis=0).max() == 0  # no depth jitter asked for
    assert not shots.scenes.move[~shots.is_slide].any()
    assert np.all(np.any(shots.scenes.move[shots.is_slide] != 0, axis=-1))


@pytest.mark.parametrize(
    ("poses", "parts"), [(5, (3, 1, 1)), (10, (6, 2, 2)), (200, (120, 40, 40))]
)
def test_splits_are_60_20_20_of_the_poses(poses, parts):
    shots = sample_taps(PoseData(stimuli=("disk", "clover"), poses=poses))
    for stimulus in range(2):
        split = shots.split[shots.scenes.stimulus == stimulus]
        assert tuple(np.bincount(split, minlength=len(SPLITS))) == parts


@pytest.mark.parametrize("draw", [sample_pairs, sample_taps])
def test_a_set_splits_its_poses_by_their_seed_stimulus_and_number(draw):
    for kind in (
        {"poses": 13, "stimuli": ("clover", "disk")},
        {"poses": 5, "seed": 7, "stimuli": ("leaf",)},
    ):
        settings = dataclasses.replace(
            PairedData(slides=3) if draw is sample_pairs else PoseData(), **kind
        )
        shots = draw(settings)
        for stimulus, pose, split in zip(
            shots.scenes.stimulus, shots.pose_id, shots.split, strict=True
        ):
            assert split == assign_split(settings.seed, settings.stimuli[stimulus], int(pose))


def test_ranges_are_those_of_the_paper_and_filled():
    shots = sample_pairs(PairedData(stimuli=("disk",), poses=400, slides=2))
    most = np.abs(shots.scenes.pose[:, :3]).max(0)
    assert np.all(most <= [5, 5, 45])
    assert np.all(most > [4.9, 4.9, 44])
    assert 1 <= shots.scenes.pose[:, 3].min() < 1.1 < 5.9 < shots.scenes.pose[:, 3].max() <= 6
    assert 2.4 < np.abs(shots.scenes.move).max() <= 2.5


def test_slides_are_along_x_along_y_or_along_both_a_third_each():
    scenes = sample_pairs(PairedData(stimuli=("disk",), poses=1000, slides=3)).scenes
    move = scenes.move.reshape(1000, 4, 2)[:, 1:]
    along = move.reshape(-1, 2) != 0
    for kind in ([True, False], [False, True], [True, True]):
        assert abs(np.mean(np.all(along == kind, axis=-1)) - 1 / 3) < 0.04
    assert np.all(np.abs(move) <= 2.5) and abs(np.mean(np.abs(move[move != 0])) - 1.25) < 0.05


def test_only_demo_tiny_and_pad_are_not_of_the_fitted_sensor():
    for known in (PAIRED, POSE):
        for name, settings in known.items():
            sensor, friction = get_config_sensor(name), settings.friction
            camera = dataclasses.replace(settings.camera, frame_px=FITTED_CAMERA.frame_px)
            is_fitted = name not in ("tiny", "demo", "pad")
            assert (sensor == TACTIP_331_FITTED and friction == FITTED_FRICTION) == is_fitted
            assert (camera == FITTED_CAMERA) == is_fitted
            if name.startswith("paper"):
                assert settings.camera.frame_px == settings.preprocess.size == 256


def test_depth_jitter_moves_taps_alone_and_never_above_the_stimulus():
    settings = PairedData(stimuli=("disk",), poses=100, taps=4, slides=4, tap_depth_jitter_mm=1.0)
    shots = sample_pairs(settings)
    still = sample_pairs(dataclasses.replace(settings, tap_depth_jitter_mm=0.0))
    moved = shots.scenes.pose - still.scenes.pose
    assert not moved[shots.is_slide].any()
    assert not moved[:, :3].any()
    assert 0.9 < np.abs(moved[~shots.is_slide, 3]).max() <= 1
    ranges = Ranges(depth_min_mm=1.0, depth_max_mm=1.01)
    shallow = sample_pairs(dataclasses.replace(settings, ranges=ranges))
    assert shallow.scenes.pose[:, 3].min() == MIN_DEPTH_MM


def test_a_stimulus_keeps_its_poses_beside_others_and_a_seed_changes_them():
    alone = sample_taps(PoseData(stimuli=("clover",), poses=9))
    beside = sample_taps(PoseData(stimuli=("disk", "clover"), poses=9))
    there = beside.scenes.stimulus == 1
    np.testing.assert_array_equal(alone.scenes.pose, beside.scenes.pose[there])
    np.testing.assert_array_equal(alone.split, beside.split[there])
    other = sample_taps(PoseData(stimuli=("clover",), poses=9, seed=5))
    assert not np.any(alone.scenes.pose == other.scenes.pose)


def test_age_runs_from_first_to_last_and_gives_nothing_of_the_shape():
    shots = sample_taps(PoseData(poses=50))
    assert (shots.age.min(), shots.age.max()) == (0, 1)
    means = [shots.age[shots.scenes.stimulus == index].mean() for index in range(3)]
    assert np.ptp(means) < 0.02


def test_friction_is_the_materials(paired):
    shots = sample_pairs(paired)
    friction, stimulus = shots.scenes.friction, shots.scenes.stimulus
    disk, spiral = set(friction[stimulus == 0]), set(friction[stimulus == 1])
    assert len(disk) == len(spiral) == 1
    assert disk != spiral
    assert set(sample_pairs(dataclasses.replace(paired, friction=0.2)).scenes.friction) == {0.2}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"stimuli": ("cube",)}, "cube"),
        ({"stimuli": ()}, "name at least one"),
        ({"stimuli": ("disk", "disk")}, "name each stimulus once"),
        ({"poses": 0}, "poses = 0"),
        ({"poses": 4}, "poses = 4: use at least 5"),
        ({"taps": 0}, "taps = 0"),
        ({"slides": 0}, "slides = 0"),
        ({"taps": 3, "slides": 2}, r"taps = 3: exceeds slides \(2\)"),
        ({"seed": -1}, "seed = -1"),
        (
            {"config": "huge"},
            "config 'huge'.*tiny, demo, calibrated, standard, skin, pad, parted, end_to_end, "
            "twisted, tilted, paper",
        ),
        ({"ranges": Ranges(depth_min_mm=0.0)}, "depth_min_mm = 0"),
        ({"ranges": Ranges(depth_min_mm=3, depth_max_mm=2)}, r"must not exceed depth_max_mm \(2\)"),
    ],
)
def test_impossible_settings_are_refused_by_name(change, line):
    with pytest.raises(UserError, match=line):
        sample_pairs(dataclasses.replace(PairedData(), **change))


def test_changed_settings_have_a_name_of_their_own():
    for known in (PAIRED, POSE):
        assert [
            compute_config_name(settings, get_config_sensor(name))
            for name, settings in known.items()
        ] == list(known)
    assert set(PAIRED) - set(POSE) == {"twisted"}  # a tap does not twist
    changed = dataclasses.replace(PairedData(), poses=7)
    names = {
        compute_config_name(changed),
        compute_config_name(changed, TACTIP_127),
        compute_config_name(PairedData(), TACTIP_127),
    }
    assert len(names) == 3
    assert all(name.startswith("custom-") and len(name) == 15 for name in names)


def test_a_full_number_and_its_float_are_one_setting():
    """A file says 4, the command line 4.0."""
    full = dataclasses.replace(PAIRED["tiny"], ranges=Ranges(lateral_mm=4))
    real = dataclasses.replace(PAIRED["tiny"], ranges=Ranges(lateral_mm=4.0))
    assert compute_config_name(full) == compute_config_name(real)


def test_the_paper_configuration_has_the_papers_counts():
    paired, pose = PAIRED["paper"], POSE["paper"]
    assert 3 * paired.poses * paired.taps == 30_000
    assert 3 * paired.poses * paired.slides == 90_000
    assert len(pose.stimuli) * pose.poses == 30_000
    assert paired.preprocess.size == pose.preprocess.size == 256


TURNING = PairedData(stimuli=("disk", "clover"), poses=60, taps=2, slides=3)


def ranged(settings, **ranges):
    return dataclasses.replace(settings, ranges=dataclasses.replace(settings.ranges, **ranges))


def test_a_twist_leaves_poses_and_moves_as_they_are_and_taps_still():
    plain, twisted, more = (
        sample_pairs(ranged(TURNING, twist_deg=most)).scenes for most in (0.0, 5.0, 20.0)
    )
    assert plain.move.shape[1] == 2 and twisted.move.shape[1] == 3
    np.testing.assert_array_equal(twisted.pose, plain.pose)
    np.testing.assert_array_equal(twisted.move[:, :2], plain.move)
    twist = twisted.move[:, 2]
    slid = np.any(plain.move != 0, axis=1)
    assert not twist[~slid].any()
    assert 4.9 < np.abs(twist).max() <= 5
    assert len(np.unique(twist[slid])) == slid.sum()
    np.testing.assert_allclose(more.move[:, 2], 4 * twist)  # the same draws, further


def test_a_tilt_is_one_for_all_shots_of_a_pose_and_uniform_over_a_disk():
    settings = ranged(dataclasses.replace(TURNING, poses=600), tilt_deg=25.0)
    plain = sample_pairs(ranged(settings, tilt_deg=0.0)).scenes
    tilted = sample_pairs(settings).scenes
    assert plain.pose.shape[1] == 4
    np.testing.assert_array_equal(tilted.pose[:, :4], plain.pose)
    np.testing.assert_array_equal(tilted.move, plain.move)
    tilt = tilted.pose[:, 4:].reshape(2, 600, 5, 2)
    assert np.ptp(tilt, axis=2).max() == 0
    size = np.linalg.norm(tilt[:, :, 0], axis=-1)
    assert 24.5 < size.max() <= 25 and abs(np.mean(size < 25 / np.sqrt(2)) - 0.5) < 0.05
    assert np.all(np.abs(tilt[:, :, 0].mean(axis=1)) < 1.5)
    taps = sample_taps(ranged(PoseData(poses=9), tilt_deg=25.0)).scenes
    assert taps.pose.shape[1] == 6 and np.all(taps.pose[:, 4:] != 0)


def test_a_set_keeps_its_name():
    """The name decides whether a stored set is found again."""
    assert compute_fingerprint(PAIRED["demo"], get_config_sensor("demo")) == "32a474d9"
    assert compute_fingerprint(POSE["standard"], get_config_sensor("standard")) == "089b591a"
