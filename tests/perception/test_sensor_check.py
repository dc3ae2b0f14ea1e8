from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxunshear.config.sensor import (
    FITTED_CAMERA,
    TACTIP_127,
    TACTIP_331,
    TACTIP_331_FITTED,
    Camera,
    Nuisance,
    Preprocess,
)
from jaxunshear.perception.lattice_fitting import compute_rest_lattice, fit_lattice, make_layout
from jaxunshear.perception.pin_detection import detect_pin_centres
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.perception.sensor_check import (
    invert_image,
    judge_image,
    judge_images,
    measure_image,
    measure_sensor_appearance,
)
from jaxunshear.simulator.camera import render_frame
from jaxunshear.simulator.pin_layout import compute_pin_tips
from tests.perception.strangers import STRANGERS, touched, varied

SENSORS = {
    "331": (TACTIP_331, Camera()),
    "127": (TACTIP_127, Camera()),
    "fitted": (TACTIP_331_FITTED, FITTED_CAMERA),
}
FULL_VIEW = View((0, 0, 256, 256))


@pytest.fixture(scope="module")
def sets():
    """By sensor, 16 images (16, 128, 128) of it and what its models expect."""
    found = {}
    for name, (sensor, camera) in SENSORS.items():
        rest = compute_rest_lattice(sensor, camera, Preprocess()).rest
        images, expected = touched(sensor, camera, 16, seed=5), measure_sensor_appearance(rest, 128)
        found[name] = SimpleNamespace(images=images, expected=expected)
    return found


def estrange(kind, images, rng):
    """Return what is made of each image, or in its place."""
    return np.array([STRANGERS[kind](image, rng) for image in images])


@pytest.mark.parametrize("name", SENSORS)
def test_known_images_are_plausible_also_turned_drifted_and_with_specks(sets, name):
    rng = np.random.default_rng(2)
    images, expected = sets[name].images, sets[name].expected
    plain = np.array([judge_image(image, expected).plausibility for image in images])
    other_day = np.array(
        [judge_image(varied(image, rng), expected).plausibility for image in images]
    )
    assert np.median(plain) > 0.95 and np.mean(plain > 0.5) > 0.9
    assert np.median(other_day) > 0.9 and np.mean(other_day > 0.5) > 0.8
    assert judge_images(images, expected).ok and judge_images(images, expected).reason == ""


@pytest.mark.parametrize("kind", STRANGERS)
def test_strangers_are_not(sets, kind):
    rng = np.random.default_rng(3)
    for name in ("331", "127"):
        made = estrange(kind, sets[name].images[:8], rng)
        likely = [judge_image(image, sets[name].expected).plausibility for image in made]
        assert np.median(likely) < 0.05, name
        assert not judge_images(made, sets[name].expected).ok


@pytest.fixture(scope="module")
def grey():
    """A frame (256, 256) in [0, 1] of the untouched sensor of 331 pins."""
    draw, tips = jax.jit(render_frame, static_argnums=(0, 1, 2)), compute_pin_tips(TACTIP_331)
    return np.asarray(draw(Camera(), TACTIP_331, Nuisance(), tips, jax.random.key(0)))


def test_what_is_seen_is_where_the_pins_are(sets, grey):
    place = compute_rest_lattice(TACTIP_331, Camera(), Preprocess()).rest
    expected = sets["331"].expected
    seen = measure_image(prepare_frame(Preprocess(), grey, FULL_VIEW))[0]
    assert seen.pins == expected.pins == 331
    assert seen.spacing == pytest.approx(expected.spacing, rel=0.02)
    assert seen.rim == pytest.approx(expected.rim, rel=0.02)
    assert (seen.column, seen.row) == pytest.approx((0.5, 0.5), abs=0.01)
    assert seen.regular == pytest.approx(expected.regular, abs=0.15)
    # 48 px from the middle, 5 px apart: the lattice's own numbers
    assert expected.rim * 128 == pytest.approx(np.hypot(*(place - 63.5).T).max(), rel=0.01)
    assert 4.5 < expected.spacing * 128 < 5.5


def test_light_images_with_dark_pins_are_noticed(sets, grey):
    expected = sets["331"].expected
    turned = np.array([invert_image(image) for image in sets["331"].images[:5]])
    said = judge_images(turned, expected)
    assert said.inverted and not said.ok and "dark pins" in said.reason
    assert not judge_images(sets["331"].images[:5], expected).inverted
    assert not judge_images(np.zeros((3, 128, 128), np.uint8), expected).inverted
    # as a camera with the other polarity gives them, before the threshold
    light = prepare_frame(Preprocess(), 1 - grey, FULL_VIEW)
    assert judge_images(light[None], expected).inverted
    # and of a sensor whose pins are others
    assert not judge_images(turned, sets["127"].expected).inverted


def test_inverse_twice_is_the_image_within_the_mask(sets):
    image = sets["331"].images[0]
    assert np.array_equal(invert_image(invert_image(image)), image)
    assert invert_image(image)[0, 0] == 0 and invert_image(image)[64, 64] == 255 - image[64, 64]


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("white noise", "dots are scattered, not a lattice"),
        ("scattered dots", "dots are scattered, not a lattice"),
        ("blank", "no pins are found"),
        ("shrunk by 15 % and more", "crop the frames alike"),
        ("zoomed by 15 % and more", "or the frames are cropped otherwise"),
        ("half covered", "or the frames are cropped otherwise"),
        ("off by 15 % and more", "or the frames are cropped otherwise"),
    ],
)
def test_reasons(sets, kind, said):
    images, expected = sets["331"].images, sets["331"].expected
    made = estrange(kind, images, np.random.default_rng(6))
    assert said in judge_images(made, expected).reason
    number = "127 pins are found, the model's sensor has 331: it is another sensor"
    assert number in judge_images(sets["127"].images, expected).reason
    assert "the model's sensor has 127: it" in judge_images(images, sets["127"].expected).reason


def test_half_of_a_folder_is_enough(sets):
    images, expected = sets["331"].images[:4], sets["331"].expected
    noise = estrange("white noise", images, np.random.default_rng(0))
    assert judge_images(np.concatenate([images, noise]), expected).ok
    assert not judge_images(np.concatenate([images[:3], noise]), expected).ok


@pytest.mark.parametrize("size", [1, 128])
@pytest.mark.parametrize("value", [0, 255])
def test_images_without_pins(sets, size, value):
    image = np.full((size, size), value, np.uint8)
    assert judge_image(image, sets["331"].expected).plausibility == 0
    assert judge_images(image[None], sets["331"].expected).reason


def test_other_sizes_are_the_same_sensor(sets):
    large = [np.kron(image, np.ones((2, 2), np.uint8)) for image in sets["331"].images[:4]]
    assert all(judge_image(image, sets["331"].expected).plausibility > 0.9 for image in large)


@pytest.mark.parametrize("name", SENSORS)
def test_images_of_another_scale_are_less_familiar(sets, name):
    sensor, camera = SENSORS[name]

    def judge(scale):
        moved = replace(camera, mm_across=camera.mm_across * scale)
        images = touched(sensor, moved, 8, seed=5)
        judged = [judge_image(image, sets[name].expected) for image in images]
        return np.median([(each.plausibility, each.familiarity) for each in judged], axis=0)

    assert judge(1.0)[1] > 0.95
    for scale in (0.95, 1.05) if sensor.pins == 331 else ():
        plausibility, familiarity = judge(scale)
        assert plausibility > 0.8 and 0.1 < familiarity < 0.75
    assert judge(0.88)[1] < judge(1.1)[1] < 0.3
    assert judge_image(np.zeros((128, 128), np.uint8), sets[name].expected).familiarity == 0


def test_real_images(sets, real_recordings):
    """Slides of one day by what taps of another day show; and neither is 127 pins, nor noise."""
    taps = _packed(real_recordings / "edge_2d_tap_train.npz", 30)
    slides = _packed(real_recordings / "edge_2d_shear_train.npz", 30)
    lattice = fit_lattice([detect_pin_centres(image) for image in taps], make_layout(TACTIP_331))
    expected = measure_sensor_appearance(lattice.rest, 128)
    likely = np.array([judge_image(image, expected).plausibility for image in slides])
    assert np.median(likely) > 0.95 and np.mean(likely > 0.5) >= 0.9
    assert np.median([judge_image(image, expected).familiarity for image in slides]) > 0.95
    assert judge_images(slides[:20], expected).ok
    reason = judge_images(slides[:20], sets["127"].expected).reason
    assert reason.startswith("about 331 pins are found, the model's sensor has 127")
    # a model of simulated images knows real ones
    assert judge_images(slides[:20], sets["331"].expected).ok


def _packed(file, count):
    packed = np.load(file)
    rows = np.random.default_rng(0).permutation(int(packed["shape"][0]))[:count]
    return np.unpackbits(packed["image_bits"][rows], axis=-1)[:, :128, :128] * np.uint8(255)
