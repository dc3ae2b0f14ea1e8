"""What pins say of a contact: closed forms, symmetries, and what must never be refused."""

import numpy as np
import pytest

from jaxunshear.angles import rotation_2d
from jaxunshear.config.sensor import FITTED_CAMERA, TACTIP_331_FITTED, Camera, Preprocess
from jaxunshear.perception import touch
from jaxunshear.perception.lattice import RIM_RINGS, make_lattice
from jaxunshear.perception.lattice_fitting import compute_rest_lattice

LATTICE = compute_rest_lattice(TACTIP_331_FITTED, FITTED_CAMERA, Preprocess())
GAUGE = touch.make_touch_gauge(LATTICE, TACTIP_331_FITTED)
INNER = LATTICE.ring < LATTICE.ring.max() - RIM_RINGS


def move(matrix, shift_px=(0.0, 0.0), noise_px=0.0):
    """Return pins (1, P, 2) px: within the rim moved by a matrix about the centre, all shifted."""
    offset = LATTICE.rest - LATTICE.centre
    motion = np.where(INNER[:, None], offset @ np.asarray(matrix).T, 0)
    noise = np.random.default_rng(0).normal(0, 1, motion.shape)
    return (LATTICE.rest + motion + shift_px + noise_px * noise)[None]


def press(size=1.0):
    """Return pins (1, P, 2) px that part about a place beside the middle, and are dragged."""
    offset = LATTICE.rest - LATTICE.centre - [6, 3]
    share = np.exp(-np.square(offset).sum(-1) / (2 * 12.0**2))[:, None]
    noise = np.random.default_rng(1).normal(0, 0.15, offset.shape)
    return (LATTICE.rest + size * share * (0.08 * offset + [1.0, -0.5]) + noise)[None]


@pytest.mark.parametrize(
    ("matrix", "divergence", "curl"),
    [
        ([[0.02, 0], [0, 0.02]], 0.04, 0),
        ([[0, -0.03], [0.03, 0]], 0, 0.06),
        ([[0.02, 0.01], [0.01, -0.02]], 0, 0),
        ([[0.03, -0.01], [0.02, 0]], 0.03, 0.03),
    ],
)
def test_divergence_and_curl_are_those_of_a_linear_motion(matrix, divergence, curl):
    field = touch.measure_field(GAUGE, move(matrix))
    middle = LATTICE.ring < 5  # whose neighbours all move so
    np.testing.assert_allclose(field.divergence[0, middle], divergence, atol=1e-9)
    np.testing.assert_allclose(field.curl[0, middle], curl, atol=1e-9)
    offset = GAUGE.mm_per_px * (LATTICE.rest - LATTICE.centre)[middle]
    expected = offset @ np.asarray(matrix).T
    np.testing.assert_allclose(field.motion_mm[0, middle], expected, atol=1e-9)


def test_mm_are_those_of_the_sensor():
    across = FITTED_CAMERA.mm_across / Preprocess().size
    assert GAUGE.mm_per_px == pytest.approx(across, rel=0.15)  # nearer to the camera at the rim


def test_noise_is_that_of_the_pins():
    field = touch.measure_field(GAUGE, move(np.zeros((2, 2)), noise_px=0.3))
    assert field.noise_mm[0] == pytest.approx(0.3 * GAUGE.mm_per_px, rel=0.25)


def test_a_shift_of_the_view_changes_nothing():
    moved = press()
    before = touch.measure_touch(GAUGE, moved)
    after = touch.measure_touch(GAUGE, moved + np.array([3, -2]))
    np.testing.assert_allclose(np.array(before), np.array(after), atol=1e-9)


def test_a_mirrored_contact_slips_as_much():
    def mirror(pins):
        return LATTICE.centre + (pins - LATTICE.centre) * [-1, 1]

    lattice = LATTICE._replace(rest=mirror(LATTICE.rest))  # with the same neighbours
    gauge = touch.make_touch_gauge(lattice, TACTIP_331_FITTED)
    before = touch.describe_field(GAUGE, touch.measure_field(GAUGE, press()))
    after = touch.describe_field(gauge, touch.measure_field(gauge, mirror(press())))
    np.testing.assert_allclose(after.slide, before.slide, atol=1e-9)
    np.testing.assert_allclose(after.curl, -before.curl, atol=1e-9)


def test_a_slide_is_described_around_the_contact_s_middle():
    """A bump by 0.8 mm lies beside the middle of the dome: each ring has more than the next."""
    offset = LATTICE.rest - LATTICE.centre - [6, 3]
    share = np.exp(-np.square(offset).sum(-1) / (2 * 12.0**2))[:, None]
    bump_px = 0.8 / GAUGE.mm_per_px * share * [[0.6, 0.8]]
    features = touch.describe_field(
        GAUGE, touch.measure_field(GAUGE, (LATTICE.rest + bump_px)[None])
    )
    rings = features.slide[0, 7:].reshape(6, -1)  # after seven logarithms
    dragged, radial, turned = rings[:3]  # of the largest motion
    assert 1 > dragged[0] > dragged[1] > dragged[2] > dragged[3] > 0
    assert np.abs(radial[0]) < 0.05 and turned[0] < 0.05
    assert np.exp(features.slide[0, 3]) == pytest.approx(0.8, rel=0.25)  # smoothed


@pytest.mark.parametrize("degrees", [30, 60, 137])
def test_a_turned_camera_turns_the_shear_alone(degrees):
    turn, centre = rotation_2d(np.radians(degrees)), LATTICE.centre

    def rotate(pins):
        return (pins - centre) @ turn.T + centre

    gauge = touch.make_touch_gauge(
        make_lattice(rotate(LATTICE.rest), LATTICE.ring), TACTIP_331_FITTED
    )
    before, after = touch.measure_touch(GAUGE, press()), touch.measure_touch(gauge, rotate(press()))
    shear = np.array([before.shear_x_mm[0], before.shear_y_mm[0]])
    found = np.array([after.shear_x_mm[0], after.shear_y_mm[0]])
    # the rim's motion is a median by axis, which is not exactly the turned one
    np.testing.assert_allclose(found, turn @ shear, atol=0.02)
    for name in ("contact", "slip", "shear_deg", "divergence", "curl"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=0.02)


def test_more_motion_never_speaks_against_a_contact():
    pins = np.concatenate([press(size) for size in (0.02, 0.1, 0.3, 1, 3)])
    contact = touch.measure_touch(GAUGE, pins).contact
    assert np.all(np.diff(contact) >= 0) and contact[0] < touch.MIN_CONTACT < 0.9 < contact[-1]
    weights = touch.load_weights().contact
    assert weights[0] <= 0 <= weights[1:-1].min()


def test_an_image_that_is_not_followed_has_nothing():
    pins = np.concatenate([press(), np.full_like(press(), np.nan), move(np.zeros((2, 2)))])
    answer = touch.measure_touch(GAUGE, pins)
    assert np.isfinite(np.array(answer)[:, 0]).all() and np.isnan(np.array(answer)[:, 1]).all()
    assert np.isfinite(answer.contact[2]) and np.isnan(answer.slip[2])
    assert touch.find_no_contact(answer).tolist() == [False, False, True]
    assert all(len(each) == 0 for each in touch.measure_touch(GAUGE, pins[:0]))


@pytest.mark.parametrize("shift", [(0, 0), (1.6, -1.2), (2.4, 0.3), (4, 3)])
@pytest.mark.parametrize("missing", [(), (3, 40, 200), range(300, 331)])
def test_an_untouched_dome_may_be_so(shift, missing):
    still = move(np.zeros((2, 2)), shift, noise_px=0.15)
    assert touch.measure_touch(GAUGE, still).contact[0] < touch.MIN_CONTACT
    order = np.random.default_rng(2).permutation(np.setdiff1d(np.arange(331), missing))
    assert touch.may_touch_nothing(GAUGE, still[0, order])


def test_a_clear_contact_is_one_without_identities():
    assert not touch.may_touch_nothing(GAUGE, press(3)[0, ::-1] + np.array([1.5, -1]))
    assert touch.may_touch_nothing(GAUGE, np.zeros((0, 2)))


def test_pins_that_are_missing_are_filled_in():
    pins = press()
    pins[0, [3, 40, 200]] = np.nan
    before, after = touch.measure_touch(GAUGE, press()), touch.measure_touch(GAUGE, pins)
    np.testing.assert_allclose(np.array(after), np.array(before), atol=0.02)


@pytest.mark.parametrize(("scale", "degrees"), [(1.0, 0), (1.7, 84)])
def test_rings_of_recorded_pins_are_drawn_to_their_untouched_places(scale, degrees):
    """The mean over contacts is wider within the rim, however the camera frames and turns it."""
    untouched = scale * (LATTICE.rest - LATTICE.centre) @ rotation_2d(np.radians(degrees)) + 70
    radius = np.linalg.norm(untouched - 70, axis=-1, keepdims=True)
    wider = 70 + (untouched - 70) * (1 + 0.06 * (1 - (radius / radius.max()) ** 2))
    gauge = touch.make_recorded_gauge(make_lattice(wider, LATTICE.ring), TACTIP_331_FITTED)
    np.testing.assert_allclose(gauge.lattice.rest, untouched, atol=0.02 * scale)
    assert touch.measure_touch(gauge, untouched[None]).contact[0] < touch.MIN_CONTACT
    assert touch.measure_touch(gauge, wider[None]).contact[0] > touch.MIN_CONTACT


def test_another_layout_has_a_gauge():
    from jaxunshear.config.sensor import TACTIP_127

    lattice = compute_rest_lattice(TACTIP_127, Camera(), Preprocess())
    gauge = touch.make_recorded_gauge(lattice, TACTIP_127)
    np.testing.assert_allclose(gauge.lattice.rest, lattice.rest, atol=1e-6)
    assert touch.measure_touch(gauge, lattice.rest[None]).contact[0] < touch.MIN_CONTACT
