"""What a touch shows, without a browser: one small contact, compiled once."""

from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.apps.explore.drawing import (
    HALF_MM,
    MAP_PX,
    render_map_svg,
    render_pins_svg,
    to_mm,
    to_px,
    trace_outlines,
)
from jaxunshear.apps.explore.explorer import (
    DEEPEST_MM,
    FREE,
    LEVEL,
    SHEARED,
    SLIPPING,
    STUCK,
    TAP,
    TRUE,
    UNSHEARED,
    Touch,
    compute_skin_state,
    list_warmup_touches,
    make_explorer,
    simulate_touch,
)
from jaxunshear.config.contact_rings import compute_max_depth_mm
from jaxunshear.config.sensor import SENSORS
from jaxunshear.config.stimuli import Outline
from jaxunshear.errors import UserError
from jaxunshear.inference.trained_model import load_model
from jaxunshear.simulator.stimuli import STIMULI, make_stimulus
from tests.helpers.image_files import png_of

ANGLE = np.linspace(0, 2 * np.pi, 100, endpoint=False)
RING = 12 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], -1)


@pytest.fixture(scope="module")
def explorer():
    return make_explorer(load_model("standard"))


@pytest.fixture(scope="module")
def touch(explorer):
    return Touch(STIMULI["disk"], explorer.model.sensor, (0.5, 1.0, 20.0, 1.2), (2.0, 0.0), 0.4)


@pytest.fixture(scope="module")
def picture(explorer, touch):
    return explorer.simulate_picture(touch)


def test_shapes_of_ones_own_are_chosen_like_the_others(explorer):
    own = make_stimulus(Outline("kite", ((0, -15), (12, 0), (0, 25), (-12, 0))))
    assert list(replace(explorer, own_stimuli=(own,)).stimuli.values()) == [own, *STIMULI.values()]
    assert list(explorer.stimuli) == list(STIMULI)


def test_a_picture_holds_both_kinds_of_image_and_what_is_read_of_them(explorer, picture):
    size = explorer.paired.preprocess.size
    images = {name: image.astype(int) for name, image in picture.images.items()}
    assert images.keys() == {SHEARED, TAP, UNSHEARED}
    assert all(image.shape == (size, size) for image in images.values())
    sheared, unsheared = (np.abs(images[n] - images[TAP]).mean() for n in (SHEARED, UNSHEARED))
    assert unsheared < sheared
    assert not picture.note
    assert 0.2 < picture.likeness[SHEARED] < picture.likeness[UNSHEARED] < 1
    assert set(picture.poses) == {TRUE, SHEARED, UNSHEARED}
    true = picture.poses[TRUE]
    assert true["x_mm"] == 0.5 and true["yaw_deg"] == 20
    far = 50 - np.hypot(50.5, 1.0)  # the disk's middle is 50 mm from its target point
    assert true["edge_mm"] == pytest.approx(-far, abs=1e-3)


def test_the_same_touch_gives_the_same_bits(explorer, touch, picture):
    again = explorer.simulate_picture(touch)
    assert all(np.array_equal(again.images[name], image) for name, image in picture.images.items())
    assert again.poses == picture.poses


def test_a_slide_drags_the_skin_behind_it(touch, picture):
    slide, tap = simulate_touch(touch).tips
    assert np.linalg.norm(slide - tap, axis=-1).max() > 0.1
    # friction holds the sensor back, yawed by 20 deg
    np.testing.assert_array_less(picture.result.force_n @ [1, 0, 0], 0)
    assert {FREE, SLIPPING} <= set(picture.result.state) <= {FREE, STUCK, SLIPPING}


def test_skin_slips_where_friction_is_used_up():
    sensor = SENSORS["tactip331-fitted"]
    force = np.zeros((1387, 3))
    force[0] = [0.2, 0, 1]
    for friction, state in ((0.4, STUCK), (0.2, SLIPPING)):
        found = compute_skin_state(sensor, force, friction)
        assert found[0] == state and (found[1:] == FREE).all()


def test_a_picture_holds_what_the_pins_show(explorer, picture):
    expected = explorer.model.touch(picture.images[SHEARED][None]).describe(0)
    assert picture.touch == pytest.approx(expected) and expected["contact"] > 0.9


def test_where_nothing_is_touched_there_are_no_predictions(explorer, touch):
    beside = replace(touch, pose=(20.0, 0.0, 0.0, 1.2))
    picture = explorer.simulate_picture(beside)
    assert picture.note.startswith("no touch: ") and picture.touch["contact"] < 0.5
    assert set(picture.poses) == {TRUE} and UNSHEARED not in picture.images
    recorded = explorer.infer_recording("a.png", png_of(picture.images[SHEARED]))
    assert recorded.note == picture.note and recorded.touch == pytest.approx(picture.touch)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"pose": (0.0, 0.0, 0.0, 12.0)}, "depth 12 mm cannot be reached"),
        ({"friction": -1.0}, "friction -1"),
        ({"pose": (np.nan, 0.0, 0.0, 2.0)}, "not finite"),
    ],
)
def test_what_cannot_be_is_refused(explorer, touch, changes, reason):
    with pytest.raises(UserError, match=reason):
        explorer.simulate_picture(replace(touch, **changes))


@pytest.mark.long
def test_a_contact_that_does_not_converge_gives_no_picture(touch):
    with pytest.raises(UserError, match="did not converge"):
        simulate_touch(touch, replace(LEVEL, limit=5, tolerance=1e-6))


def test_a_recorded_image_is_read_as_unshear_reads_it(explorer, picture):
    seen = explorer.infer_recording("slide.png", png_of(picture.images[SHEARED]))
    assert np.array_equal(seen.images[UNSHEARED], picture.images[UNSHEARED])
    assert TRUE not in seen.poses and seen.poses[UNSHEARED] == picture.poses[UNSHEARED]


@pytest.mark.parametrize(
    ("name", "image", "reason"),
    [
        ("a.txt", None, "a.txt: no readable image"),
        ("n.png", np.random.default_rng(0).integers(0, 256, (200, 200), np.uint8), "n.png: "),
        ("flat.png", np.full((64, 64), 9, np.uint8), "flat.png: "),
    ],
    ids=["text", "noise", "flat"],
)
def test_a_file_that_is_none_of_the_sensor_s_images_is_refused(explorer, name, image, reason):
    with pytest.raises(UserError, match=reason) as refused:
        explorer.infer_recording(name, b"words" if image is None else png_of(image))
    assert "\n" not in str(refused.value)


def test_outlines_run_along_the_edge_and_close_at_the_border():
    (disk,) = trace_outlines(make_stimulus(Outline("ring", tuple(map(tuple, RING)))), HALF_MM)
    np.testing.assert_allclose(np.linalg.norm(disk - disk.mean(axis=0), axis=-1), 12, atol=0.3)
    (half,) = trace_outlines(STIMULI["edge"], HALF_MM)
    assert half[:, 0].min() < -31.5 and half[:, 0].max() == pytest.approx(0, abs=1e-4)


def test_places_go_there_and_back(touch, picture):
    assert to_mm(MAP_PX / 2, 0) == (0, HALF_MM)
    np.testing.assert_allclose(to_px(np.array(to_mm(100, 500))), [100, 500])
    assert render_map_svg(touch).count("<circle") == 6
    pins = render_pins_svg(picture.pins, picture.result.state, 128)
    assert pins.count("<circle") == 1 + len(picture.result.state)


@pytest.mark.long
def test_what_is_made_ready_reaches_as_deep_as_the_page():
    sensor = SENSORS["tactip331-fitted"]
    touches = list_warmup_touches(sensor, 0.4)
    assert 10 < len(touches) < 20
    assert touches[-1].pose[3] == DEEPEST_MM < compute_max_depth_mm(sensor)


@pytest.mark.long
def test_pins_need_a_folder_for_recorded_images():
    with pytest.raises(UserError, match="--like"):
        make_explorer(load_model("skin")).infer_recording("a.png", b"")
