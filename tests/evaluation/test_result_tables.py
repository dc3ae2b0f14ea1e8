"""Tables on known answers: means by group, ratios, recovery, intervals, and what is shown."""

import numpy as np
import pytest

from jaxunshear.evaluation.contact_scores import ContactScores
from jaxunshear.evaluation.evaluate import select_typical
from jaxunshear.evaluation.intervals import compute_intervals
from jaxunshear.evaluation.result_tables import build_tables, tabulate_by_size
from jaxunshear.evaluation.score import CELL_METRICS, CELLS
from jaxunshear.evaluation.simulated_evaluation import summarise_contact_quality

QUANTITIES = ("x_mm", "yaw_deg", "edge_mm", "edge_deg")
KINDS = ("tap", "sheared", "entangled", "disentangled")
NAMES = ("disk", "clover", "teardrop")
STIMULUS = np.array([0, 0, 0, 0, 1, 1])  # no teardrop
POSE_ID = np.array([0, 0, 1, 1, 0, 1])
ERRORS = {"tap": 1.0, "sheared": 5.0, "entangled": 3.0, "disentangled": 2.0}


def made_up(errors=ERRORS, without=(), **changed):
    """Make scores of six contacts, those of two poses of a disk and two of a clover."""
    similarity = np.array([0.1, 0.2, 0.3, 0.4, 0.9, 0.7], np.float32)
    scores = {f"ms_ssim/{kind}": similarity for kind in KINDS[1:]}
    for kind in KINDS:
        scores |= {f"pose/{kind}/{name}": np.full(6, errors[kind]) for name in QUANTITIES}
    for cell in CELLS:
        scores |= {f"swap/{cell}/{metric}": np.full(6, 0.5) for metric in CELL_METRICS}
    scores = {name: score for name, score in scores.items() if not name.startswith(without)}
    return as_contacts(scores | changed)


def as_contacts(scores, stimulus=STIMULUS, pose_id=POSE_ID):
    labels = {"stimulus": stimulus, "pose_id": pose_id}
    return ContactScores(scores, labels, np.zeros(0, int), {}, {})


UNEVEN = {"pose/disentangled/x_mm": np.array([1, 1, 2, 2, 4, 5], np.float32)}


def test_means_by_stimulus_and_overall():
    found = build_tables(made_up(), NAMES)
    row = found.ms_ssim["disentangled"]
    assert row["disk"] == pytest.approx(0.25)
    assert row["clover"] == pytest.approx(0.8)
    assert row["teardrop"] is None
    assert row["overall"] == pytest.approx(2.6 / 6)
    low, high = found.spread.ms_ssim["disentangled"]["overall"]
    assert low < row["overall"] < high
    assert found.spread.ms_ssim["disentangled"]["teardrop"] is None
    assert found.spread.over == "test poses of one training"


def test_ratio_and_recovery():
    found = build_tables(made_up(), NAMES)
    assert found.pose_mae["sheared"]["edge_mm"] == 5
    assert found.pose_ratio["disentangled"]["edge_mm"] == pytest.approx(0.4)
    assert found.pose_recovery["disentangled"]["edge_mm"] == pytest.approx(0.75)
    assert found.pose_recovery["entangled"]["edge_deg"] == pytest.approx(0.5)
    undamaged = build_tables(made_up(dict.fromkeys(KINDS, 2.0)), NAMES)
    assert undamaged.pose_recovery["entangled"]["x_mm"] is None
    perfect = build_tables(made_up(dict.fromkeys(KINDS, 0.0)), NAMES)
    assert perfect.pose_ratio["entangled"]["x_mm"] is None


def test_poses_of_each_stimulus_are_those_of_its_contacts_alone():
    contacts = made_up(**UNEVEN)
    found = build_tables(contacts, NAMES).pose_by_stimulus
    assert found["disk"].pose_mae["disentangled"]["x_mm"] == pytest.approx(1.5)
    assert found["disk"].pose_recovery["disentangled"]["x_mm"] == pytest.approx(3.5 / 4)
    assert found["disk"].spread.pose_recovery["disentangled"]["x_mm"] == pytest.approx([0.75, 1.0])
    assert found["clover"].pose_ratio["disentangled"]["x_mm"] == pytest.approx(0.9)
    assert found["teardrop"] is None
    disk = {name: score[:4] for name, score in contacts.scores.items()}
    alone = build_tables(as_contacts(disk, STIMULUS[:4], POSE_ID[:4]), ("disk",))
    assert found["disk"].spread.pose_mae == alone.spread.pose_mae


def test_poses_of_each_depth_are_those_of_its_contacts_alone():
    # parts meet at 2 and 3 mm; a bound belongs to the deeper part
    depth = np.array([1.0, 1.5, 2.9, 2.6, 3.0, 2.0])
    found = tabulate_by_size(made_up(**UNEVEN), depth, 1.0, 4.0)
    error = {name: part.pose_mae["disentangled"]["x_mm"] for name, part in found.items()}
    assert error == pytest.approx({"1.0-2.0 mm": 1.0, "2.0-3.0 mm": 3.0, "3.0-4.0 mm": 4.0})
    middle = found["2.0-3.0 mm"]
    assert middle.pose_recovery["disentangled"]["x_mm"] == pytest.approx((5 - 3) / 4)
    # two poses, drawn with their slides: errors (2 + 2) / 2 and 5
    assert middle.spread.pose_mae["disentangled"]["x_mm"] == pytest.approx([2.0, 5.0])


def test_depths_without_contacts_are_null_and_one_depth_or_no_pose_is_not_divided():
    found = tabulate_by_size(made_up(), np.full(6, 1.5), 1.0, 4.0)
    assert [part is None for part in found.values()] == [False, True, True]
    assert tabulate_by_size(made_up(), np.full(6, 2.0), 2.0, 2.0) == {}
    assert tabulate_by_size(made_up(without=("pose/",)), np.full(6, 1.5), 1.0, 4.0) == {}
    narrow = tabulate_by_size(made_up(), np.full(6, 2.0), 2.0, 2.06)
    assert list(narrow) == ["2.000-2.020 mm", "2.020-2.040 mm", "2.040-2.060 mm"]


def test_tables_hold_what_there_is():
    kinds = ("ms_ssim/entangled", "pose/entangled", "swap/DC(z_s)")
    found = build_tables(made_up(without=kinds), NAMES)
    assert list(found.ms_ssim) == ["sheared", "disentangled"]
    assert list(found.pose_mae) == ["tap", "sheared", "disentangled"]
    assert set(found.swap) == set(CELLS) - {"DC(z_s)"}
    direct = {f"pose/sheared_learnt/{name}": np.ones(6, np.float32) for name in QUANTITIES}
    # a PoseNet that learnt slides, and none that learnt taps
    found = build_tables(made_up(without=("pose/",), **direct), NAMES)
    assert found.pose_mae == {"sheared_learnt": dict.fromkeys(QUANTITIES, 1)}
    assert found.pose_recovery == {}


def test_intervals_are_repeatable_and_seeded():
    values = {"a": np.random.default_rng(0).normal(size=40)}
    poses = np.arange(40)
    assert compute_intervals(values, poses, 1) == compute_intervals(values, poses, 1)
    assert compute_intervals(values, poses, 1) != compute_intervals(values, poses, 2)


def test_interval_width_is_the_standard_error_of_independent_poses():
    generator = np.random.default_rng(3)
    by_pose = generator.normal(size=200)
    once = compute_intervals({"a": by_pose}, np.arange(200), 0)["a"]
    assert once[1] - once[0] == pytest.approx(2 * 1.96 * by_pose.std() / np.sqrt(200), rel=0.1)
    # ten equal slides at each pose say nothing new: the interval stays as wide
    often = compute_intervals({"a": np.repeat(by_pose, 10)}, np.repeat(np.arange(200), 10), 0)["a"]
    assert often == pytest.approx(once)


def test_recorded_slides_to_one_pose_are_drawn_together():
    contacts = as_contacts({}, np.zeros(4, int), np.array([3, 9, 3, 9]))
    contacts.labels["number"] = np.arange(4)  # each is another contact
    np.testing.assert_array_equal(contacts.poses, [0, 1, 0, 1])


def test_the_same_pose_number_of_two_stimuli_is_two_poses():
    scores = {name: score[:2] for name, score in made_up().scores.items()}
    scores["ms_ssim/sheared"] = np.array([0.0, 1.0])
    found = build_tables(as_contacts(scores, np.array([0, 1]), np.array([7, 7])), NAMES)
    low, high = found.spread.ms_ssim["sheared"]["overall"]
    assert (low, high) == (0, 1)  # one pose alone would give an interval of no width


def test_contact_quality_known_answer():
    found = summarise_contact_quality({"residual_mm": np.array([1.0, 2, 3, 10])})
    assert found == {
        "residual_mm": {"mean": 4, "median": 2.5, "p95": pytest.approx(8.95), "max": 10}
    }


def test_typical_shows_low_middling_and_high_of_each_stimulus():
    scores = np.array([0.5, 0.1, 0.9, 0.4, 0.6, 0.3])
    assert select_typical(scores, np.array([0, 0, 0, 1, 1, 1])).tolist() == [1, 0, 2, 5, 3, 4]
    assert select_typical(scores[:1], np.array([2])).tolist() == [0]
