"""From arrays to results.json with an oracle, networks that do nothing, and made-up data."""

import json

import numpy as np
import pytest

from jaxunshear.config.data import PairedData, Ranges
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.targets import make_range_targets, read_true_values
from jaxunshear.evaluation import contact_scores
from jaxunshear.evaluation.contact_scores import BATCH, FIELDS, Scorer, score_test
from jaxunshear.evaluation.evaluate import collect_montage, collect_scores
from jaxunshear.evaluation.measurements import build_measurements
from jaxunshear.evaluation.score import CELLS, Outputs, compute_chance_errors, score_images
from jaxunshear.evaluation.simulated_evaluation import build_simulated_results, mark_smooth
from jaxunshear.models.modality import IMAGES
from tests.helpers.reproducible import select_results

SIZE, PITCH = 128, 8
TARGETS = make_range_targets((), Ranges())
KINDS = ("tap", "sheared", "entangled", "disentangled")  # of a run with the paper's networks


def lattice(shift):
    """A lattice of dots and its centres (P, 2) as (column, row), moved by `shift` px."""
    axis = np.arange(24, SIZE - 24, PITCH, dtype=np.float32)
    pins = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + np.asarray(shift, np.float32)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    away = np.hypot(columns[..., None] - pins[:, 0], rows[..., None] - pins[:, 1]).min(axis=-1)
    return np.where(away < 2.2, 255, 0).astype(np.uint8)[..., None], pins


def contacts(count=9):
    """Every field of a batch; sheared images are the tap's moved by (2, 1) px."""
    generator = np.random.default_rng(0)
    taps, slides = lattice((0, 0)), lattice((2, 1))
    batch = {
        "canonical": np.stack([taps[0]] * count),
        "sheared": np.stack([slides[0]] * count),
        "canonical_pins": np.stack([taps[1]] * count),
        "sheared_pins": np.stack([slides[1]] * count),
        "stimulus": np.arange(count) % 3,
        "pose_id": np.arange(count) // 6,
        "pose": generator.uniform(-5, 5, (count, 4)).astype(np.float32),
        "edge": generator.uniform((-5, -170), (5, 170), (count, 2)).astype(np.float32),
        "move": np.ones((count, 2), np.float32),
        "residual_mm": np.linspace(0, 1e-3, count, dtype=np.float32),
        **{name: np.arange(count) for name in ("iterations", "stuck", "slipping", "free")},
    }
    assert set(FIELDS) == set(batch)
    return batch


def score(full, run, size, keep):
    """Score contacts in batches of a size."""
    count, batches = len(full["sheared"]), []
    for start in range(0, count, size):
        batches.append({name: value[start : start + size] for name, value in full.items()})
    test = contact_scores.TestSet(batches, count, IMAGES.pair, keep=keep)
    return score_test(Scorer(run, TARGETS), test)


def oracle(full, sizes=None, step=4):
    """Make networks that unshear perfectly (disentangled) or not at all (entangled).

    Pose errors are known by kind.
    """
    wrong = {"tap": 0.0, "sheared": 4.0, "entangled": 4.0, "disentangled": 1.0}
    place = [0]

    def run(tap, sheared):
        if sizes is not None:
            sizes.append((len(tap), len(sheared)))
        tap, sheared = tap.astype(np.float32) / 255, sheared.astype(np.float32) / 255
        images = {"tap": tap, "sheared": sheared, "entangled": sheared, "disentangled": tap}
        drawn = {"DC(z_p)": tap, "DC(z_s)": sheared, "DS(z_p,z_s)": sheared, "DS(z_p,z_p)": tap}
        index = np.arange(place[0], place[0] + len(tap)) % len(full["pose"])
        place[0] += step
        true = read_true_values(TARGETS, {name: full[name][index] for name in ("pose", "edge")})
        poses = {
            kind: {name: value + wrong[kind] for name, value in true.items()} for kind in KINDS
        }
        return Outputs(images, drawn, poses, {}), score_images(images, drawn)

    return run


@pytest.fixture(scope="module")
def gathered():
    full = contacts()
    return score(full, oracle(full), 4, keep=7)


@pytest.fixture(scope="module")
def results(gathered):
    return build_simulated_results(Experiment(name="made up", claim="none"), gathered)


def test_an_oracle_is_perfect_and_doing_nothing_changes_nothing(results):
    found = results.ms_ssim
    assert found["disentangled"]["overall"] == pytest.approx(1, abs=1e-5)
    assert found["entangled"] == found["sheared"]
    assert found["sheared"]["overall"] < 0.7
    assert results.pose_mae["tap"]["edge_deg"] == pytest.approx(0, abs=1e-4)
    assert results.pose_mae["sheared"]["edge_deg"] == pytest.approx(4, abs=1e-4)
    assert results.pose_recovery["disentangled"]["edge_mm"] == pytest.approx(0.75, abs=1e-4)
    assert results.pose_recovery["entangled"]["edge_mm"] == pytest.approx(0, abs=1e-4)


def test_the_swap_gives_right_codes_from_wrong_ones(results):
    swap = results.swap
    assert set(swap) == set(CELLS)
    for right, wrong in (("DC(z_p)", "DC(z_s)"), ("DS(z_p,z_s)", "DS(z_p,z_p)")):
        assert swap[right].mse == 0
        assert swap[right].ssim == pytest.approx(1, abs=1e-5)
        assert swap[wrong].mse > 0.02
        assert swap[wrong].ms_ssim < 0.7


def test_pin_error_is_that_of_the_known_shift(results):
    pins = results.pin_error
    assert pins["disentangled"]["rms_px"] < 0.15
    assert pins["disentangled"]["missed_per_image"] == 0
    assert pins["sheared"]["rms_px"] == pytest.approx(np.hypot(2, 1), abs=0.15)
    assert pins["true_slide"]["rms_px"] == pytest.approx(np.hypot(2, 1), abs=1e-4)
    mm_per_px = Experiment("", "").paired.camera.mm_across / SIZE
    assert pins["true_slide"]["rms_mm"] == pytest.approx(np.hypot(2, 1) * mm_per_px, rel=1e-4)


def test_what_is_measured_is_named(results):
    assert results.metric["ms_ssim"] == "ms_ssim@4"
    assert results.metric["image_px"] == SIZE
    assert results.counts.test_by_stimulus == {"disk": 3, "clover": 3, "teardrop": 3}
    assert results.counts.test_poses == 6
    assert results.paper["ms_ssim"]["disentangled"]["overall"] == 0.93
    assert results.seeds["bootstrap"] == 0


def test_results_are_the_same_bits_again_and_go_into_json(gathered, results):
    again = build_simulated_results(Experiment(name="made up", claim="none"), gathered)
    assert json.dumps(select_results(again)) == json.dumps(select_results(results))


def test_networks_are_compared_contact_by_contact(gathered, results):
    apart = gathered.scores["ms_ssim/disentangled"] - gathered.scores["ms_ssim/entangled"]
    found = results.difference["entangled"]
    assert found["ms_ssim"] == pytest.approx(float(apart.mean()))
    assert found["edge_mm"] == pytest.approx(-3, abs=1e-4)
    low, high = results.spread.difference["entangled"]["edge_mm"]
    # both err by a fixed amount, so nothing is uncertain about the difference
    assert high - low < 1e-4 < abs(low)
    recovery = results.spread.pose_recovery["disentangled"]["edge_mm"]
    assert recovery == pytest.approx([0.75, 0.75], abs=1e-4)


def test_a_test_of_its_own_has_tables_of_its_own(gathered):
    experiment = Experiment(name="made up", claim="none", unseen=("flower", "leaf", "spiral_1"))
    found = build_simulated_results(experiment, gathered, {"unseen": gathered})
    test = found.tests["unseen"]
    assert list(test.ms_ssim["disentangled"]) == ["flower", "leaf", "spiral_1", "overall"]
    assert test.contacts == 9
    assert test.pose_mae == found.pose_mae
    rows = build_measurements(found).rows
    assert "unseen.ms_ssim.disentangled.flower" in {row.name for row in rows}
    assert sum(row.ok is not None for row in rows) == 4  # the bars are for the test split alone


def test_scores_are_kept_contact_by_contact(gathered):
    kept = collect_scores(gathered)
    poses = [name for name in gathered.labels if name.startswith("pose.")]
    labels = ("stimulus", "pose_id", "slide_mm", "depth_mm", *poses)
    assert set(kept) == {*gathered.scores, *labels} and "pose.sheared.edge_mm" in poses
    np.testing.assert_allclose(kept["slide_mm"], np.sqrt(2))
    np.testing.assert_allclose(
        np.abs(kept["pose.sheared.edge_mm"] - kept["pose.true.edge_mm"]),
        kept["pose/sheared/edge_mm"],
        atol=1e-5,
    )
    for name, score in gathered.scores.items():
        np.testing.assert_array_equal(kept[name], score)


def test_edge_angles_are_also_given_where_the_edge_has_one_direction(gathered):
    """Of the first five contacts here; without the marks the results say nothing of it."""
    experiment = Experiment(name="made up", claim="none")
    smooth = np.arange(len(gathered.labels["stimulus"])) < 5
    marks = gathered._replace(labels=gathered.labels | {"smooth": smooth})
    found = build_simulated_results(experiment, marks)
    assert found.counts.test_smooth == 5
    for kind, errors in found.pose_smooth.pose_mae.items():
        mean = gathered.scores[f"pose/{kind}/edge_deg"][:5].mean(dtype=float)
        assert errors == {"edge_deg": pytest.approx(mean)}
    names = {row.name for row in build_measurements(found).rows}
    assert "pose_smooth.disentangled.edge_deg" in names
    unmarked = build_simulated_results(experiment, gathered)
    assert found.pose_mae == unmarked.pose_mae and unmarked.pose_smooth is None
    kept = collect_scores(marks)
    np.testing.assert_array_equal(kept["smooth"], smooth)


def test_marks_are_of_the_contacts_poses(gathered):
    pose = np.array([[-50.0, 0, 0, 3], [0.0, 0, 0, 3]])
    labels = gathered.labels | {"stimulus": np.zeros(2, int), "pose": pose}
    marked = mark_smooth(gathered._replace(labels=labels), PairedData(stimuli=("disk",)))
    assert marked.labels["smooth"].tolist() == [False, True]


def test_measurements_of_results_have_the_bars(results):
    rows = build_measurements(results).rows
    barred = {row.name: row.ok for row in rows if row.ok is not None}
    assert len(barred) == 4
    assert barred["ms_ssim.disentangled.overall"]
    assert barred["pose_ratio.disentangled.edge_mm"]


def test_batches_of_any_size_gather_the_same(gathered):
    full, sizes = contacts(), []
    other = score(full, oracle(full, sizes, 9), 9, keep=7)
    assert sizes == [(BATCH, BATCH)]
    for name in gathered.scores:
        np.testing.assert_array_equal(gathered.scores[name], other.scores[name])
    np.testing.assert_array_equal(gathered.kept_rows, other.kept_rows)
    for kind in KINDS:
        np.testing.assert_array_equal(gathered.images[kind], other.images[kind])


def test_the_last_batch_is_filled_up_so_that_one_shape_is_compiled():
    full, sizes = contacts(), []
    found = score(full, oracle(full, sizes), 4, keep=3)
    assert sizes == [(BATCH, BATCH)] * 3
    assert all(len(value) == 9 for value in found.scores.values())
    assert found.kept_rows.tolist() == [0, 4, 8]
    assert found.images["tap"].shape == (3, SIZE, SIZE)


def test_montage_holds_a_few_of_each_stimulus(gathered):
    shown = collect_montage(("disk", "clover", "teardrop"), gathered)
    assert set(shown["stimulus"].tolist()) == {"disk", "clover", "teardrop"}
    count = len(shown["stimulus"])
    assert 3 <= count <= 9
    for kind in KINDS:
        assert shown[kind].shape == (count, SIZE, SIZE)
        assert shown[kind].dtype == np.uint8
    np.testing.assert_allclose(shown["ms_ssim_disentangled"], 1, atol=1e-5)


def test_chance_is_the_error_of_one_answer():
    pose, edge = np.zeros((4, 4)), np.zeros((4, 2))
    pose[:, 0] = [-2, -1, 1, 2]
    edge[:, 1] = [170, 180, -170, -180]
    found = compute_chance_errors(read_true_values(TARGETS, {"pose": pose, "edge": edge}), TARGETS)
    assert found["x_mm"] == pytest.approx(1.5)
    assert found["edge_deg"] == pytest.approx(5)  # not 175: angles meet behind 180
    assert found["yaw_deg"] == 0
