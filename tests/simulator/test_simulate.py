"""Scenes through the dome of a real sensor: what a contact must look like, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxunshear.config.sensor import TACTIP_331, TACTIP_331_FITTED
from jaxunshear.errors import UserError
from jaxunshear.simulator.contacts import compute_indentation
from jaxunshear.simulator.level import LEVELS
from jaxunshear.simulator.paths import Paths, make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes, make_scenes, sample_poses, sample_slides
from jaxunshear.simulator.simulate import follow, simulate
from jaxunshear.simulator.stimuli import TRAINING
from tests.golden import make_runs
from verification.paper import NAMES, sample_paper_scenes

REST = compute_pin_tips(TACTIP_331)
DISK = ("disk",)
FINE = replace(LEVELS["auto"], tolerance=0.02, limit=3000)


def sample_scenes(count=12, depth=(1.0, 3.0)):
    generator = np.random.default_rng(0)
    pose = sample_poses(generator, count, 5.0, 45.0, depth)
    move = sample_slides(generator, count, 2.5)
    return make_scenes(TRAINING, generator.integers(0, 3, count), pose, move)


def make_scene(depth, x=0.0, move=(0.0, 0.0), yaw=0.0, friction=0.3):
    pose, move = np.array([[x, 0.0, yaw, depth]]), np.array([move], float)
    return Scenes(np.zeros(1, int), pose, move, np.array([friction]))


def make_path(*points, friction=0.5):
    return Paths(np.zeros(1, int), np.array([friction]), np.array([points], float))


def simulate_path(*points, friction=0.5):
    return follow(TACTIP_331, DISK, make_path(*points, friction=friction))[0]


def compute_rms_mm(pins, others):
    return np.sqrt(np.mean(np.sum((pins - others) ** 2, -1), -1))


@pytest.fixture(scope="module")
def contacts():
    return simulate(TACTIP_331, TRAINING, sample_scenes())


def test_contacts_report_their_quality(contacts):
    assert contacts.converged.all() and contacts.pins.shape == (12, 331, 3)
    assert np.all(contacts.residual_mm > 0) and np.all(contacts.iterations > 0)
    touching = contacts.stuck_nodes + contacts.slipping_nodes
    assert np.all(touching > 0) and np.all(touching <= contacts.nodes)
    assert np.all(contacts.force_n[:, 2] > 0) and not contacts.retried.any()


def test_golden_pins_of_contacts(contacts):
    moved = contacts.pins.astype(np.float64) - REST
    rms = np.sqrt(np.mean(np.sum(moved**2, -1), -1))
    found = {
        "motion of all pins, mm": make_runs.summarise([moved]),
        "rms motion of each contact's pins, mm": rms.tolist(),
        "motion of a pin in each contact, mm": moved[:, 40].tolist(),
        "forces, N": contacts.force_n.astype(np.float64).tolist(),
    }
    make_runs.hold("contacts with the paper's shapes", found)


def test_order_and_company_do_not_matter(contacts):
    order = np.random.default_rng(1).permutation(12)
    shuffled = simulate(TACTIP_331, TRAINING, sample_scenes().take(order))
    np.testing.assert_allclose(shuffled.pins, contacts.pins[order], atol=1e-5)
    alone = simulate(TACTIP_331, TRAINING, sample_scenes().take(np.array([3])))
    # the batch stops together, so company may only make an answer more exact
    np.testing.assert_allclose(alone.pins[0], contacts.pins[3], atol=3e-2)


def test_auto_agrees_with_reference(contacts):
    some = np.arange(4)
    reference = simulate(TACTIP_331, TRAINING, sample_scenes().take(some), level="reference")
    assert reference.converged.all() and reference.pins.dtype == np.float64
    # mm: 0.3 px at 256
    assert np.percentile(compute_rms_mm(contacts.pins[some], reference.pins), 95) < 0.04


@pytest.mark.long
def test_omissions_change_next_to_nothing():
    few = sample_scenes(4, (2.0, 2.6))
    fine = replace(FINE, omit=("nodes", "untouched", "grouping", "friction"))
    sparing = simulate(TACTIP_331, TRAINING, few, fine)
    entire = simulate(TACTIP_331, TRAINING, few, replace(fine, omit=()))
    assert np.all(sparing.nodes < 0.25 * entire.nodes)
    assert compute_rms_mm(sparing.pins, entire.pins).max() < 2e-3


@pytest.mark.parametrize(("depth", "x"), [(-0.5, 0.0), (0.0, 0.0), (1.0, 15.0)])
def test_no_contact_leaves_the_pins_exactly_where_they_are(depth, x):
    found = simulate(TACTIP_331, DISK, make_scene(depth, x))
    np.testing.assert_array_equal(found.pins[0], REST.astype(np.float32))
    assert not np.any(found.force_n) and found.converged.all() and not found.nodes.any()


def test_a_tap_on_a_flat_is_symmetric_and_pushes_up():
    found = simulate(TACTIP_331, DISK, make_scene(2.0, x=-25.0))
    lift = (found.pins[0] - REST)[:, 2]
    assert lift[0] > 1.0
    np.testing.assert_allclose(lift[1:7], lift[1:7].mean(), atol=1e-3)
    assert np.abs(found.force_n[0, :2]).max() < 1e-3 * found.force_n[0, 2]


def test_a_slide_drags_the_skin_behind_it_and_friction_bounds_the_force():
    found = simulate(TACTIP_331, DISK, make_scene(2.0, x=-15.0, move=(2.5, 0.0)))
    assert (found.pins[0] - REST)[0, 0] < -0.3
    # full slip after 2.5 mm at this depth
    assert np.hypot(*found.force_n[0, :2]) == pytest.approx(0.3 * found.force_n[0, 2], rel=0.01)
    assert found.stuck_nodes[0] == 0


def test_a_scene_turned_by_a_sixth_has_the_same_answer_turned():
    straight, turned = (
        simulate(TACTIP_331, DISK, make_scene(2.0, x=-25.0, move=(1.5, 0.0), yaw=yaw))
        for yaw in (0.0, -60.0)
    )
    rotation = Rotation.from_euler("z", 60, degrees=True)
    tolerance = 2e-3 * straight.force_n[0, 2]
    expected = rotation.apply(straight.force_n[0])
    np.testing.assert_allclose(turned.force_n[0], expected, atol=tolerance)
    apart = rotation.apply(straight.pins[0])[:, None] - turned.pins[0][None]
    assert np.linalg.norm(apart, axis=-1).min(1).max() < 5e-3


def test_friction_from_none_to_infinite():
    pulls = []
    for friction in (0.0, 1e-6, 0.2, 5.0, 1e4, np.inf):
        scene = make_scene(2.0, x=-25.0, move=(1.0, 0.0), friction=friction)
        found = simulate(TACTIP_331, DISK, scene)
        assert found.converged.all()
        pulls.append(-found.force_n[0, 0] / found.force_n[0, 2])
    assert pulls[0] == 0 and np.all(np.diff(pulls[:4]) > 0)
    assert pulls[4] == pytest.approx(pulls[5], rel=1e-3)
    assert found.slipping_nodes[0] == 0 and found.stuck_nodes[0] > 0


def test_strong_friction_needs_no_stronger_level():
    """Deep presses, where the rings that come to touch are held where they were."""
    deep = sample_paper_scenes("slide", 12, 1).take(np.array([0, 3]))
    deep = replace(deep, friction=np.full(2, np.inf))
    stuck = simulate(TACTIP_331_FITTED, NAMES, deep, retry=False)
    assert stuck.converged.all() and not stuck.slipping_nodes.any() and stuck.iterations.max() < 600


def test_a_motion_in_two_parts_is_the_motion():
    start, pressed = [-26.0, 0, 0, 0, 0, 0], [-26.0, 0, 0, 2.5, 0, 0]
    end = [-25.0, 0.5, 10, 2.5, 3, 0]
    entire, _ = follow(TACTIP_331, DISK, make_path(start, pressed, end), FINE)
    _, skins = follow(TACTIP_331, DISK, make_path(start, pressed), FINE)
    parts, _ = follow(TACTIP_331, DISK, make_path(pressed, end), FINE, start=skins)
    assert compute_rms_mm(entire.pins, parts.pins).max() < 2e-3
    fresh, _ = follow(TACTIP_331, DISK, make_path([-25.0, 0.5, 10, 0, 3, 0], end), FINE)
    assert compute_rms_mm(entire.pins, fresh.pins).max() > 0.1  # the history does matter
    with pytest.raises(UserError, match="starts elsewhere"):
        follow(TACTIP_331, DISK, make_path(start, end), FINE, start=skins)


def test_twist_turns_the_skin_and_a_mirrored_twist_mirrors_it():
    start, pressed = [-25, 0, 0, 0, 0, 0], [-25, 0, 0, 3, 0, 0]
    there, back = (
        simulate_path(start, pressed, [-25, 0, angle, 3, 0, 0]).pins[0] - REST
        for angle in (20.0, -20.0)
    )
    around = (REST[:, 0] * there[:, 1] - REST[:, 1] * there[:, 0])[1:7]
    assert np.all(around < -0.2)  # the skin stays behind the sensor, which turns counter-clockwise
    np.testing.assert_allclose(there[0], back[0] * [1, -1, 1], atol=1e-3)


def test_a_mirrored_scene_gives_the_mirrored_pins():
    """Of shapes that are their own mirror images, under pins that are theirs."""
    shapes = ("disk", "clover", "teardrop", "flower", "leaf", "edge", "surface")
    generator = np.random.default_rng(4)
    pose = sample_poses(generator, 14, 5.0, 45.0, (1.0, 4.0))
    move, which = sample_slides(generator, 14, 2.5), np.arange(14) % len(shapes)
    there, other = (
        simulate(TACTIP_331, shapes, make_scenes(shapes, which, pose * sign, move * sign[:2]))
        for sign in (np.ones(4), np.array([1, -1, -1, 1]))
    )
    mirror = np.array([1, -1, 1])
    twin = np.argmin(np.linalg.norm(REST[:, None] - REST * mirror, axis=-1), 0)
    assert compute_rms_mm(there.pins, other.pins[:, twin] * mirror).max() < 0.02
    assert compute_rms_mm(there.pins, other.pins).min() > 0.1


def test_a_tilted_sphere_touches_elsewhere_with_nearly_the_same_force():
    level, leaning = (
        simulate_path([-25, 0, 0, 0, tilt, 0], [-25, 0, 0, 2, tilt, 0], friction=0.0)
        for tilt in (0.0, 20.0)
    )
    normal = np.array([0, np.sin(np.radians(20.0)), np.cos(np.radians(20.0))])
    push = leaning.force_n[0] @ normal
    # without friction the force is normal
    assert np.linalg.norm(leaning.force_n[0] - push * normal) < 0.02 * push
    assert push == pytest.approx(level.force_n[0, 2], rel=0.1)  # the clamped base is nearer
    moved = np.linalg.norm(leaning.pins[0] - REST, axis=-1)
    assert REST[moved.argmax(), 1] < -4  # the dome's lowest point lies at -R sin(20 deg) = -6.8 mm


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        *(("pose", np.nan, "pose"), ("move", np.inf, "move"), ("stimulus", 7, "stimulus 7")),
        *(("friction", -0.1, "friction"), ("friction", np.nan, "friction")),
        ("pose", [0, 0, 0, 99.0], "cannot be reached"),
    ],
)
def test_bad_scenes_are_refused_by_name(field, value, message):
    bad = make_scene(2.0)
    getattr(bad, field)[0] = value
    with pytest.raises(UserError, match=message):
        simulate(TACTIP_331, DISK, bad)


def test_bad_paths_and_levels_are_refused():
    for option, value in (("level", "nonsense"), ("batch", 0)):
        with pytest.raises(UserError, match=option):
            simulate(TACTIP_331, DISK, make_scene(1.0), **{option: value})
    for points, said in (
        (([0, 0, 0, 0, 50, 0], [0, 0, 0, 3, 50, 0]), "tilt of 50 deg"),
        (([0, 0, 0, 0, 0, 0],), "shape"),
        (([-20, 0, 0, 3, 0, 0],) * 2, "stays where it begins"),
    ):
        with pytest.raises(UserError, match=said):
            simulate_path(*points)


def test_contacts_that_do_not_converge_are_solved_again_and_reported():
    hopeless = replace(LEVELS["auto"], tolerance=1e-3, limit=5)
    given_up = simulate(TACTIP_331, TRAINING, sample_scenes(3), hopeless, retry=False)
    assert not given_up.converged.any()
    saved = simulate(TACTIP_331, TRAINING, sample_scenes(3), hopeless)
    assert saved.converged.all() and saved.retried.all()
    assert np.all(saved.residual_mm < given_up.residual_mm)


def test_scenes_are_paths(contacts):
    followed, skins = follow(TACTIP_331, TRAINING, make_paths(sample_scenes()))
    np.testing.assert_array_equal(followed.pins, contacts.pins)
    np.testing.assert_allclose(skins.force_n.sum(axis=1), contacts.force_n, atol=1e-6)


@pytest.mark.parametrize(
    ("level", "x", "depth"),
    [
        ("auto", 10.3, 3.0),
        ("fast", 13.8, 6.0),
        pytest.param("auto", 13.8, 6.0, marks=pytest.mark.long),
        pytest.param("fast", 10.3, 3.0, marks=pytest.mark.long),
    ],
)
def test_a_grazing_touch_is_simulated(level, x, depth):
    """No node that usually suffices is near the disk, and others lie 0.5 mm inside."""
    grazed, entire = (
        simulate(TACTIP_331, TRAINING, make_scene(depth, x, friction=0.7), each)
        for each in (level, "default")
    )
    assert grazed.converged.all() and entire.force_n[0, 2] > 0.1
    assert grazed.force_n[0, 2] == pytest.approx(entire.force_n[0, 2], rel=0.1)
    assert compute_rms_mm(grazed.pins, entire.pins)[0] < 0.02


def test_no_scenes_give_no_contacts():
    none = make_paths(make_scene(3.0)).take(np.zeros(0, int))
    contacts, skins = follow(TACTIP_331, TRAINING, none)
    assert contacts.pins.shape == (0, 331, 3) and len(contacts.converged) == len(skins.force_n) == 0


def test_standing_still_in_contact_keeps_its_force():
    rest, pressed = [-20, 0, 0, 0, 0, 0], [-20, 0, 0, 3, 0, 0]
    contacts, skins = follow(TACTIP_331, TRAINING, make_path(rest, pressed))
    held = make_path(pressed, pressed)
    again, _ = follow(TACTIP_331, TRAINING, held, start=skins)
    np.testing.assert_allclose(again.force_n, contacts.force_n, rtol=1e-3)
    with pytest.raises(UserError, match="nodes; these are 1 with 9"):
        follow(TACTIP_331, TRAINING, held, start=skins._replace(force_n=np.zeros((1, 9, 3))))


def press(sensor, x, depth=3.0):
    """Compute the indentation at (x, 0) mm from the disk's edge; at -20 mm its face is flat."""
    paths = make_paths(make_scene(depth, x, friction=0.5))
    return compute_indentation(sensor, follow(sensor, DISK, paths)[1])[0]


# the fitted one has pins beyond the contact nodes
@pytest.mark.parametrize("sensor", [TACTIP_331, TACTIP_331_FITTED], ids=lambda each: each.name)
def test_a_face_presses_the_skin_in_as_far_as_the_dome_would_reach_into_it(sensor):
    found = press(sensor, -20.0)
    outward = compute_pin_tips(sensor) - [0, 0, sensor.dome_radius_mm]
    angle = np.arccos(-outward[:, 2] / np.linalg.norm(outward, axis=-1))
    reach = 3.0 - sensor.dome_radius_mm * (1 - np.cos(angle))  # along the axis
    inside = reach > 0.8
    np.testing.assert_allclose(found[inside], (reach * np.cos(angle))[inside], atol=0.25)
    assert abs(found[0] - 3.0) < 0.05
    assert np.abs(found[angle > 0.95 * angle.max()]).max() < 0.5


def test_an_edge_presses_in_one_side_only_and_no_contact_none():
    found, x = press(TACTIP_331, 0.0), REST[:, 0]
    near = np.linalg.norm(REST[:, :2], axis=-1) < 7
    assert found[near & (x < -4)].min() > found[near & (x > 4)].max()
    assert not np.any(press(TACTIP_331, 0.0, depth=-1.0))
