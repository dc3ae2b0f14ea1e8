"""Scenes through the dome of a real sensor: what a contact must look like, and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.config.reach import compute_max_depth_mm
from jaxunshear.config.sensor import TACTIP_331, TACTIP_331_FITTED
from jaxunshear.errors import UserError
from jaxunshear.simulator.level import LEVELS, without_omissions
from jaxunshear.simulator.paths import Paths, make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes, make_scenes, sample_poses, sample_slides
from jaxunshear.simulator.scheduler import cut_increments
from jaxunshear.simulator.simulate import follow, simulate
from jaxunshear.simulator.stimuli import TRAINING
from tests.golden import make_runs
from verification.paper import NAMES, sample_paper_scenes

REST = compute_pin_tips(TACTIP_331)


def scenes(count=12, depth=(1.0, 3.0), seed=0, slide=True):
    generator = np.random.default_rng(seed)
    pose = sample_poses(generator, count, 5.0, 45.0, depth)
    move = sample_slides(generator, count, 2.5) * slide
    return make_scenes(TRAINING, generator.integers(0, 3, count), pose, move)


def one(depth, x=0.0, move=(0.0, 0.0), yaw=0.0, friction=0.3, y=0.0):
    return Scenes(
        np.zeros(1, int),
        np.array([[x, y, yaw, depth]]),
        np.array([move], float),
        np.array([friction]),
    )


def path(*points, friction=0.5):
    return Paths(np.zeros(1, int), np.array([friction]), np.array([points], float))


def rms_mm(pins, others):
    return np.sqrt(np.mean(np.sum((pins - others) ** 2, -1), -1))


@pytest.fixture(scope="module")
def contacts():
    return simulate(TACTIP_331, TRAINING, scenes())


def test_contacts_say_how_good_they_are(contacts):
    assert contacts.converged.all() and contacts.pins.shape == (12, 331, 3)
    assert np.all(contacts.residual_mm > 0) and np.all(contacts.iterations > 0)
    assert np.all(contacts.stuck_nodes + contacts.slipping_nodes > 0)
    assert np.all(contacts.stuck_nodes + contacts.slipping_nodes <= contacts.nodes)
    assert np.all(contacts.force_n[:, 2] > 0)
    assert not contacts.retried.any()


def test_golden_pins_of_contacts(contacts):
    moved = contacts.pins.astype(np.float64) - REST
    found = {
        "motion of all pins, mm": make_runs.summarise([moved]),
        "rms motion of each contact's pins, mm": np.sqrt(
            np.mean(np.sum(moved**2, -1), -1)
        ).tolist(),
        "motion of a pin in each contact, mm": moved[:, 40].tolist(),
        "forces, N": contacts.force_n.astype(np.float64).tolist(),
    }
    make_runs.hold("contacts with the paper's shapes", found)


def test_order_and_company_do_not_matter(contacts):
    order = np.random.default_rng(1).permutation(12)
    shuffled = simulate(TACTIP_331, TRAINING, scenes().take(order))
    np.testing.assert_allclose(shuffled.pins, contacts.pins[order], atol=1e-5)
    alone = simulate(TACTIP_331, TRAINING, scenes().take(np.array([3])))
    # the batch stops together, so company may only make an answer more exact
    np.testing.assert_allclose(alone.pins[0], contacts.pins[3], atol=3e-2)


def test_auto_agrees_with_reference(contacts):
    some = np.arange(4)
    reference = simulate(TACTIP_331, TRAINING, scenes().take(some), level="reference")
    assert reference.converged.all() and reference.pins.dtype == np.float64
    assert (
        np.percentile(rms_mm(contacts.pins[some], reference.pins), 95) < 0.04
    )  # mm: 0.3 px at 256


@pytest.mark.long
def test_what_is_left_out_changes_next_to_nothing():
    few = scenes(4, (2.0, 2.6))
    fine = replace(
        LEVELS["auto"],
        tolerance=0.02,
        limit=3000,
        omit=("nodes", "untouched", "grouping", "friction"),
    )
    sparing, entire = (
        simulate(TACTIP_331, TRAINING, few, level) for level in (fine, without_omissions(fine))
    )
    assert np.all(sparing.nodes < 0.25 * entire.nodes)
    assert rms_mm(sparing.pins, entire.pins).max() < 2e-3


def test_no_contact_leaves_the_pins_exactly_where_they_are():
    for scene in (one(-0.5), one(0.0), one(1.0, x=15.0)):
        made = simulate(TACTIP_331, ("disk",), scene)
        np.testing.assert_array_equal(made.pins[0], REST.astype(np.float32))
        assert not np.any(made.force_n) and made.converged.all() and not made.nodes.any()


def test_a_tap_on_a_flat_is_symmetric_and_pushes_up():
    made = simulate(TACTIP_331, ("disk",), one(2.0, x=-25.0))
    lift = (made.pins[0] - REST)[:, 2]
    assert lift[0] > 1.0
    ring = lift[1:7]
    np.testing.assert_allclose(ring, ring.mean(), atol=1e-3)
    assert np.abs(made.force_n[0, :2]).max() < 1e-3 * made.force_n[0, 2]


def test_a_slide_drags_the_skin_behind_it_and_friction_bounds_the_force():
    made = simulate(TACTIP_331, ("disk",), one(2.0, x=-15.0, move=(2.5, 0.0)))
    assert (made.pins[0] - REST)[0, 0] < -0.3
    pull = np.hypot(*made.force_n[0, :2])
    assert pull == pytest.approx(
        0.3 * made.force_n[0, 2], rel=0.01
    )  # full slip after 2.5 mm at this depth
    assert made.stuck_nodes[0] == 0


@pytest.mark.parametrize("angle", [60.0, 25.0])
def test_turning_the_scene_turns_the_answer(angle):
    """By a sixth exactly; by another angle as far as the rings of nodes allow."""
    straight = simulate(TACTIP_331, ("disk",), one(2.0, x=-25.0, move=(1.5, 0.0)))
    turned = simulate(TACTIP_331, ("disk",), one(2.0, x=-25.0, move=(1.5, 0.0), yaw=-angle))
    back = np.radians(angle)
    rotation = np.array(
        [[np.cos(back), -np.sin(back), 0], [np.sin(back), np.cos(back), 0], [0, 0, 1]]
    )
    np.testing.assert_allclose(
        turned.force_n[0], rotation @ straight.force_n[0], atol=2e-3 * straight.force_n[0, 2]
    )
    if angle == 60:
        nearest = np.linalg.norm(
            (straight.pins[0] @ rotation.T)[:, None] - turned.pins[0][None], axis=-1
        ).min(1)
        assert nearest.max() < 5e-3


def test_friction_from_none_to_infinite():
    slide = {"x": -25.0, "move": (1.0, 0.0)}
    pulls = []
    for friction in (0.0, 1e-6, 0.2, 5.0, 1e4, np.inf):
        made = simulate(TACTIP_331, ("disk",), one(2.0, friction=friction, **slide))
        assert made.converged.all()
        pulls.append(-made.force_n[0, 0] / made.force_n[0, 2])
    assert pulls[0] == 0 and np.all(np.diff(pulls[:4]) > 0)
    assert pulls[4] == pytest.approx(pulls[5], rel=1e-3)
    stuck = simulate(TACTIP_331, ("disk",), one(2.0, friction=np.inf, **slide))
    assert stuck.slipping_nodes[0] == 0 and stuck.stuck_nodes[0] > 0


def test_strong_friction_needs_no_stronger_level():
    """Deep presses, where the rings that come to touch are held where they were."""
    drawn = sample_paper_scenes("slide", 12, 1).take(np.array([0, 3]))
    stuck = simulate(
        TACTIP_331_FITTED, NAMES, replace(drawn, friction=np.full(2, np.inf)), retry=False
    )
    assert stuck.converged.all() and not stuck.slipping_nodes.any() and stuck.iterations.max() < 600


def test_strong_friction_is_pressed_by_short_increments_and_usual_friction_as_before():
    points = np.repeat(np.array([[[0, 0, 0, 0, 0, 0], [0, 0, 0, 6.0, 0, 0]]]), 3, axis=0)
    _, count = cut_increments(
        Paths(np.zeros(3, int), np.array([0.5, 1.0, np.inf]), points), LEVELS["auto"], 20.0
    )
    np.testing.assert_array_equal(count, [2, 2, 6])


def test_a_motion_in_two_parts_is_the_motion():
    start, pressed, end = (
        [-26.0, 0, 0, 0, 0, 0],
        [-26.0, 0, 0, 2.5, 0, 0],
        [-25.0, 0.5, 10, 2.5, 3, 0],
    )
    fine = replace(LEVELS["auto"], tolerance=0.02, limit=3000)
    entire, _ = follow(TACTIP_331, ("disk",), path(start, pressed, end), fine)
    _, skins = follow(TACTIP_331, ("disk",), path(start, pressed), fine)
    parts, _ = follow(TACTIP_331, ("disk",), path(pressed, end), fine, start=skins)
    assert rms_mm(entire.pins, parts.pins).max() < 2e-3
    fresh, _ = follow(TACTIP_331, ("disk",), path([-25.0, 0.5, 10, 0, 3, 0], end), fine)
    assert rms_mm(entire.pins, fresh.pins).max() > 0.1  # the history does matter
    with pytest.raises(UserError, match="starts elsewhere"):
        follow(TACTIP_331, ("disk",), path(start, end), fine, start=skins)


def test_twist_turns_the_skin_and_a_mirrored_twist_mirrors_it():
    found = {}
    for angle in (20.0, -20.0):
        made, _ = follow(
            TACTIP_331,
            ("disk",),
            path([-25, 0, 0, 0, 0, 0], [-25, 0, 0, 3, 0, 0], [-25, 0, angle, 3, 0, 0]),
        )
        assert made.converged.all()
        found[angle] = made.pins[0] - REST
    around = (REST[:, 0] * found[20.0][:, 1] - REST[:, 1] * found[20.0][:, 0])[1:7]
    assert np.all(around < -0.2)  # the skin stays behind the sensor, which turns counter-clockwise
    mirrored = found[-20.0][0] * [1, -1, 1]
    np.testing.assert_allclose(found[20.0][0], mirrored, atol=1e-3)
    assert np.mean(np.abs(found[20.0][1:7, 2] - found[-20.0][[1, 6, 5, 4, 3, 2], 2])) < 5e-3


def test_a_mirrored_scene_gives_the_mirrored_pins():
    """Of shapes that are their own mirror images, under pins that are theirs."""
    shapes = ("disk", "clover", "teardrop", "flower", "leaf", "edge", "surface")
    generator = np.random.default_rng(4)
    pose = sample_poses(generator, 14, 5.0, 45.0, (1.0, 4.0))
    move, which = sample_slides(generator, 14, 2.5), np.arange(14) % len(shapes)
    there = simulate(TACTIP_331, shapes, make_scenes(shapes, which, pose, move))
    other = simulate(
        TACTIP_331, shapes, make_scenes(shapes, which, pose * [1, -1, -1, 1], move * [1, -1])
    )
    flipped = REST * [1, -1, 1]
    twin = np.argmin(np.linalg.norm(REST[:, None] - flipped[None], axis=-1), 0)
    np.testing.assert_allclose(REST[twin], flipped, atol=1e-9)
    assert rms_mm(there.pins, other.pins[:, twin] * [1, -1, 1]).max() < 0.02
    assert rms_mm(there.pins, other.pins).min() > 0.1


def test_a_tilted_sphere_touches_elsewhere_with_nearly_the_same_force():
    level, leaning = (
        follow(
            TACTIP_331, ("disk",), path([-25, 0, 0, 0, t, 0], [-25, 0, 0, 2, t, 0], friction=0.0)
        )[0]
        for t in (0.0, 20.0)
    )
    assert leaning.converged.all()
    normal = np.array([0, np.sin(np.radians(20.0)), np.cos(np.radians(20.0))])
    push = leaning.force_n[0] @ normal
    assert (
        np.linalg.norm(leaning.force_n[0] - push * normal) < 0.02 * push
    )  # without friction the force is normal
    assert push == pytest.approx(
        level.force_n[0, 2], rel=0.1
    )  # the clamped base is nearer on one side
    moved = np.linalg.norm(leaning.pins[0] - REST, axis=-1)
    assert REST[moved.argmax(), 1] < -4  # the dome's lowest point lies at -R sin(20 deg) = -6.8 mm


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("pose", np.nan, "pose"),
        ("move", np.inf, "move"),
        ("friction", -0.1, "friction"),
        ("friction", np.nan, "friction"),
        ("depth", 99.0, "cannot be reached"),
        ("stimulus", 7, "stimulus 7"),
    ],
)
def test_bad_scenes_are_refused_by_name(field, value, message):
    bad = one(2.0)
    if field == "depth":
        bad.pose[0, 3] = value
    else:
        getattr(bad, field)[0] = value
    with pytest.raises(UserError, match=message):
        simulate(TACTIP_331, ("disk",), bad)


def test_bad_paths_and_levels_are_refused():
    with pytest.raises(UserError, match="level"):
        simulate(TACTIP_331, ("disk",), one(1.0), level="nonsense")
    with pytest.raises(UserError, match="tilt of 50 deg"):
        follow(TACTIP_331, ("disk",), path([0, 0, 0, 0, 50, 0], [0, 0, 0, 3, 50, 0]))
    with pytest.raises(UserError, match="shape"):
        follow(TACTIP_331, ("disk",), path([0, 0, 0, 0, 0, 0]))
    with pytest.raises(UserError, match="batch = 0"):
        simulate(TACTIP_331, ("disk",), one(1.0), batch=0)


def test_what_does_not_converge_is_solved_again_and_said():
    hopeless = replace(LEVELS["auto"], tolerance=1e-3, limit=5)
    given_up = simulate(TACTIP_331, TRAINING, scenes(3), hopeless, retry=False)
    assert not given_up.converged.any()
    saved = simulate(TACTIP_331, TRAINING, scenes(3), hopeless)
    assert saved.converged.all() and saved.retried.all()
    assert np.all(saved.residual_mm < given_up.residual_mm)


def test_scenes_are_paths(contacts):
    followed, skins = follow(TACTIP_331, TRAINING, make_paths(scenes()))
    np.testing.assert_array_equal(followed.pins, contacts.pins)
    np.testing.assert_allclose(skins.force_n.sum(axis=1), contacts.force_n, atol=1e-6)


def test_the_deepest_pose_of_the_paper_is_covered():
    assert compute_max_depth_mm(TACTIP_331) > 6.0


@pytest.mark.parametrize(
    ("level", "x", "depth"),
    [
        ("auto", 10.3, 3.0),
        ("fast", 13.8, 6.0),
        pytest.param("auto", 13.8, 6.0, marks=pytest.mark.long),
        pytest.param("fast", 10.3, 3.0, marks=pytest.mark.long),
    ],
)
def test_a_grazing_touch_is_felt(level, x, depth):
    """No node that usually suffices is near the disk, and others lie 0.5 mm inside."""
    grazed, entire = (
        simulate(TACTIP_331, TRAINING, one(depth, x, friction=0.7), each)
        for each in (level, "default")
    )
    assert grazed.converged.all() and entire.force_n[0, 2] > 0.1
    assert grazed.force_n[0, 2] == pytest.approx(entire.force_n[0, 2], rel=0.1)
    assert rms_mm(grazed.pins, entire.pins)[0] < 0.02


def test_no_scenes_give_no_contacts():
    contacts, skins = follow(TACTIP_331, TRAINING, make_paths(one(3.0)).take(np.zeros(0, int)))
    assert (
        contacts.pins.shape == (0, 331, 3)
        and contacts.converged.shape == (0,)
        and len(skins.force_n) == 0
    )


def test_standing_still_in_contact_needs_a_skin_to_start_from():
    held = path([-20, 0, 0, 3, 0, 0], [-20, 0, 0, 3, 0, 0])
    with pytest.raises(UserError, match="stays where it begins"):
        follow(TACTIP_331, TRAINING, held)
    contacts, skins = follow(TACTIP_331, TRAINING, path([-20, 0, 0, 0, 0, 0], [-20, 0, 0, 3, 0, 0]))
    again, _ = follow(TACTIP_331, TRAINING, held, start=skins)
    np.testing.assert_allclose(again.force_n, contacts.force_n, rtol=1e-3)
    with pytest.raises(UserError, match=r"nodes; these are 1 with 9"):
        follow(TACTIP_331, TRAINING, held, start=skins._replace(force_n=np.zeros((1, 9, 3))))
