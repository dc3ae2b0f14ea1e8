"""What is learnt of simulated contacts, on contacts whose answer is known."""

import numpy as np
import pytest

from benchmarks import bench_touch, touch_fitting
from jaxunshear.perception import touch

ZONES = len(touch.ZONES) - 1


def make_touches(count=400):
    """Contacts whose shear is linear in the features, and whose motion stands out of noise.

    Half of the contact slips where two features of the slide have one sign, a tenth where not.
    """
    rng = np.random.default_rng(0)
    nodes = np.where(np.arange(count) % 3, 20, 0)
    sizes = rng.normal(-3, 0.1, (count, 1 + ZONES))
    sizes[:, 1:] += np.where(nodes > 0, rng.uniform(1, 3, count), 0)[:, None]
    vectors, turns = rng.normal(0, 0.3, (count, ZONES, 2)), rng.normal(0, 1, (count, 2 * ZONES))
    drag = np.column_stack([vectors[:, 0] + 2 * vectors[:, 1], turns[:, 0] - turns[:, 3]])
    slide = rng.choice([-1, 1], (count, 3)) + rng.normal(0, 0.1, (count, 3))
    slip = np.where(slide[:, 0] * slide[:, 1] > 0, 0.5, 0.1)
    features = touch.TouchFeatures(sizes, slide, vectors, turns, sizes[:, 0], sizes[:, 0])
    depth = np.where(nodes > 0, 1.0, 0.0)
    return touch_fitting.Touches(
        features, np.arange(count), depth, nodes, slip, drag, np.ones(count)
    )


@pytest.fixture(scope="module")
def learnt():
    return touch_fitting.learn_weights([make_touches(200)], [make_touches(400)])


def test_shear_is_learnt_with_its_interval(learnt):
    np.testing.assert_allclose(learnt.shear, [1, 2, 0, 0], atol=0.02)
    np.testing.assert_allclose(learnt.turn, [1, 0, 0, -1, 0, 0, 0, 0], atol=0.02)
    assert np.all((learnt.half_width > 0) & (learnt.half_width < 0.05))


def test_no_motion_speaks_against_a_contact(learnt):
    assert learnt.contact[touch_fitting.NOISE] <= 0 <= learnt.contact[1:-1].min()


def test_scores_are_those_of_contacts_that_are_known(learnt):
    scores = bench_touch.score_touches(make_touches(), learnt)
    assert (scores["auc"], scores["refused"], scores["refused_untouched"]) == (1, 0, 1)
    assert scores["slip_rms"] < 0.05 and scores["shear_rms_mm"] < 0.02
    assert scores["inside_mm"] == pytest.approx(0.95, abs=0.04)


def test_slip_needs_no_drag_and_leaves_the_rest_as_it_is(learnt):
    undragged = make_touches(400)._replace(drag=np.full((400, 3), np.nan))
    without = touch_fitting.learn_weights([make_touches(200)], [undragged])
    for name in learnt._fields:
        np.testing.assert_array_equal(getattr(without, name), getattr(learnt, name))
    other = touch_fitting.learn_weights([make_touches(200)], [])
    assert not np.array_equal(other.slip, learnt.slip)
    np.testing.assert_array_equal(other.contact, learnt.contact)


def test_the_file_of_weights_is_loaded_as_it_was_learnt(learnt, tmp_path):
    (tmp_path / "touch.json").write_text(touch_fitting.format_weights(learnt))
    loaded = touch.load_weights(tmp_path / "touch.json")
    for name in learnt._fields:
        np.testing.assert_allclose(getattr(loaded, name), getattr(learnt, name), atol=1e-5)
