"""Preprocessing against scikit-image, and `prepare_frame` on frames of every kind, good and bad."""

from functools import partial

import jax
import numpy as np
import pytest
from PIL import Image
from skimage.filters import threshold_local
from skimage.transform import resize_local_mean

from jaxunshear.config.sensor import TACTIP_331, Camera, Nuisance, Preprocess
from jaxunshear.errors import UserError
from jaxunshear.metrics.errors import measure_pin_error
from jaxunshear.perception import grey
from jaxunshear.perception.pin_detection import detect_pin_centres
from jaxunshear.perception.preprocess import (
    View,
    _frame_pins,
    binarise,
    combine_views,
    crop_frame,
    find_dome,
    find_view,
    find_white_level,
    prepare_frame,
    to_grey,
)
from jaxunshear.simulator.camera import compute_outer_fraction, project, render_frame, to_image_px
from jaxunshear.simulator.pin_layout import compute_pin_tips

CAMERA = Camera()
OUTER = compute_outer_fraction(CAMERA, TACTIP_331)
SIZES = pytest.mark.parametrize("size", [128, 256])


def binarise_reference(preprocess, grey):
    """Binarise one (H, H) crop by scikit-image, in the order of published pipelines."""
    small = resize_local_mean(np.asarray(grey, np.float64), (preprocess.size, preprocess.size))
    block = 2 * round(preprocess.block * preprocess.size / 2) + 1
    threshold = threshold_local(
        small, block, method="mean", offset=-preprocess.offset, mode="reflect"
    )
    away = np.hypot(*(np.mgrid[: preprocess.size, : preprocess.size] + 0.5 - preprocess.size / 2))
    white = (small > threshold) & (away <= preprocess.mask_radius * preprocess.size)
    return np.where(white, np.uint8(255), np.uint8(0))


def check_agreement(preprocess, image, grey):
    """Check an image, of a crop, against scikit-image's."""
    assert np.mean(np.asarray(image) == binarise_reference(preprocess, grey)) >= 0.999


def pressed(seed):
    """Pin tips of a made-up contact: pushed up and aside under a patch."""
    rng = np.random.default_rng(seed)
    tips = compute_pin_tips(TACTIP_331)
    patch = np.exp(-((np.hypot(*(tips[:, :2] - rng.uniform(-3, 3, 2)).T) / 6) ** 2))[:, None]
    return tips + patch * np.array([*rng.uniform(-2, 2, 2), rng.uniform(1, 3)])


@pytest.fixture(scope="module")
def frames():
    """Four undeformed and four pressed frames (8, F, F)."""
    tips = np.float32([compute_pin_tips(TACTIP_331)] * 4 + [pressed(seed) for seed in range(4)])
    keys = jax.random.split(jax.random.key(3), len(tips))
    draw = jax.vmap(lambda tip, key: render_frame(CAMERA, TACTIP_331, Nuisance(), tip, key))
    return np.asarray(draw(tips, keys))


def photograph(square, height=480, width=640, side=400, top=30, left=150, light=0.75):
    """Make a colour photograph (height, width, 3) uint8 of the frame, in a light surround."""
    small = np.asarray(Image.fromarray(square).resize((side, side), Image.Resampling.BOX))
    full = np.full((height + 400, width + 400), light, np.float32)
    full[200 + top : 200 + top + side, 200 + left : 200 + left + side] = small
    full = full[200 : 200 + height, 200 : 200 + width]
    return np.round(255 * full[..., None] * np.array([0.8, 1.0, 0.9])).clip(0, 255).astype(np.uint8)


@SIZES
def test_agrees_with_scikit_image_on_simulated_frames(frames, size):
    preprocess = Preprocess(size=size)
    ours = np.asarray(jax.jit(binarise, static_argnums=0)(preprocess, frames))
    assert ours.shape == (8, size, size)
    assert set(np.unique(ours)) == {0, 255}
    for image, frame in zip(ours, frames, strict=True):
        check_agreement(preprocess, image, frame)


@pytest.mark.parametrize(("before", "size"), [(100, 128), (425, 128), (425, 256), (97, 64)])
def test_agrees_with_scikit_image_at_uneven_ratios(before, size):
    smooth = np.random.default_rng(0).random((before // 5 + 1, before // 5 + 1)).astype(np.float32)
    grey = np.kron(smooth, np.ones((5, 5), np.float32))[:before, :before]
    check_agreement(Preprocess(size=size), binarise(Preprocess(size=size), grey), grey)


def test_vmap_equals_a_batch_and_a_single_frame(frames):
    run = partial(binarise, Preprocess())
    batch = np.asarray(run(frames))
    np.testing.assert_array_equal(jax.vmap(run)(frames), batch)
    np.testing.assert_array_equal(run(frames[0]), batch[0])
    nested = run(frames.reshape(2, 4, *frames.shape[1:]))
    np.testing.assert_array_equal(nested.reshape(batch.shape), batch)
    with pytest.raises(ValueError, match=r"\(64, 32\)"):
        run(np.zeros((64, 32)))


@SIZES
def test_every_pin_of_an_undeformed_frame_is_found_where_it_is(frames, size):
    preprocess = Preprocess(size=size)
    images = np.asarray(binarise(preprocess, frames[:4]))
    assert [len(detect_pin_centres(image)) for image in images] == [331] * 4
    projected = project(CAMERA, compute_pin_tips(TACTIP_331), TACTIP_331)
    true = np.asarray(to_image_px(CAMERA, preprocess, projected))
    error = measure_pin_error(images, np.tile(true[None], (4, 1, 1)), limit_px=5.0)
    assert error["missed_per_image"] == error["extra_per_image"] == 0
    assert error["rms_px"] < 0.3


def test_the_mask_blackens_what_is_outside(frames):
    images = np.asarray(binarise(Preprocess(size=64, mask_radius=0.3, offset=-1.0), frames[:1]))[0]
    rows, columns = np.indices(images.shape) - 31.5
    np.testing.assert_array_equal(images > 0, np.hypot(rows, columns) <= 0.3 * 64)


@pytest.mark.parametrize(
    ("side", "top", "left"), [(400, 30, 150), (300, 120, 20), (460, 10, 90), (420, -15, 200)]
)
@SIZES
def test_the_dome_is_found_wherever_it_lies(frames, side, top, left, size):
    photo = photograph(frames[0], side=side, top=top, left=left)
    found = detect_pin_centres(prepare_frame(Preprocess(size=size), photo))
    assert abs(len(found) - 331) <= 1
    reach = np.hypot(*(found - (size - 1) / 2).T).max() / size
    assert reach == pytest.approx(OUTER, abs=0.01)


@pytest.fixture(scope="module")
def dark():
    """A frame whose dome has no housing ring around it."""
    nuisance = Nuisance(housing_ring=False, specks=0)
    tips = compute_pin_tips(TACTIP_331)
    return np.asarray(render_frame(CAMERA, TACTIP_331, nuisance, tips, jax.random.key(0)))


def test_pins_in_a_dark_surround_are_found_too(dark):
    photo = photograph(dark, side=380, top=60, left=200, light=0.03)
    box = find_dome(to_grey(photo), Preprocess().outer_pins)
    np.testing.assert_allclose(box, [200, 60, 580, 440], atol=8)
    assert len(detect_pin_centres(prepare_frame(Preprocess(size=256), photo))) == 331


@pytest.mark.parametrize("scale", [1.0, 0.75])
def test_a_square_frame_that_is_dark_all_round_is_framed_by_its_pins(dark, scale):
    """Its corners, which an opening would round, are not taken for a dome's rim."""
    side = len(dark)
    start = (round(side / scale) - side) // 2
    around = np.pad(dark, start, constant_values=dark.min())
    box = find_dome(around, Preprocess().outer_pins)
    np.testing.assert_allclose(box, [start, start, start + side, start + side], atol=0.02 * side)


def test_a_bbox_is_obeyed(frames):
    photo = photograph(frames[0], side=400, top=30, left=150)
    image = prepare_frame(Preprocess(size=256), photo, View((150, 30, 550, 430)))
    same = np.asarray(binarise(Preprocess(size=256), frames[0]))
    assert np.mean(image == same) > 0.97
    assert crop_frame(np.zeros((20, 30)), (5, 2, 15, 8)).shape == (10, 10)
    with pytest.raises(UserError, match="bbox"):
        prepare_frame(Preprocess(), photo, View((700, 0, 800, 100)))


@pytest.mark.parametrize(
    "convert",
    [
        lambda grey: grey.astype(np.uint16) * 257,
        lambda grey: np.round(grey * (4095 / 255)).astype(np.uint16),  # twelve bits
        lambda grey: grey / 255,
        lambda grey: grey * 257.0,
        lambda grey: np.stack([grey, grey, grey, np.full_like(grey, 255)], -1),
        lambda grey: grey[..., None],
        lambda grey: np.stack([grey, np.full_like(grey, 255)], -1),
    ],
    ids=["uint16", "twelve_bits", "float", "float_of_16_bits", "rgba", "one_channel", "grey_alpha"],
)
def test_number_types_and_channels_do_not_matter(frames, convert):
    grey = np.round(255 * to_grey(photograph(frames[0]))).astype(np.uint8)
    images = [prepare_frame(Preprocess(), each) for each in (convert(grey), grey)]
    assert np.mean(images[0] == images[1]) > 0.999


@pytest.mark.parametrize(
    ("frame", "white"),
    [
        (np.eye(40, dtype=bool), 1),
        (np.eye(40, dtype=np.uint16), 1),
        (np.full((40, 40), 200, np.uint8), 255),
        (np.full((40, 40), 1000, np.uint16), 1023),
        (np.full((40, 40), 1030, np.uint16), 4095),
        (np.full((40, 40), 70_000, np.int32), 70_000),
        (np.full((40, 40), 1.2), 1),
        (np.full((40, 40), 200.0), 255),
        (np.where(np.arange(1600).reshape(40, 40) == 7, 2.0, 0.5), 1),
        (np.full((40, 40, 4), [4000, 4000, 4000, 65535], np.uint16), 4095),
    ],
)
def test_white_is_the_range_that_a_camera_fills(frame, white):
    assert find_white_level(frame) == white


def test_a_darker_frame_of_the_same_camera_has_the_same_white(frames):
    grey = to_grey(photograph(frames[0]))
    grey = grey / np.quantile(grey, 0.999)
    bright, dark = (np.round(most * grey).astype(np.uint16) for most in (1100, 1000))
    shared = View(None, (("uint16", find_white_level(bright)),))
    expected = prepare_frame(Preprocess(), bright)
    other, off = (
        np.mean(prepare_frame(Preprocess(), dark, view) != expected) for view in (shared, View())
    )
    assert other < 0.5 * off, (other, off)


def test_frames_of_other_types_in_a_folder_keep_their_white(frames):
    """A folder may hold photographs and masks: none is black beside a wider type's white."""
    photo = photograph(frames[0])
    raws = [photo, photo.astype(np.uint16) * 257, (photo[..., 0] > 150).astype(np.uint8)]
    view = combine_views([find_view(Preprocess(), raw) for raw in raws])
    assert dict(view.whites) == {"uint8": 255, "uint16": 65535}
    for raw in raws:
        alone = prepare_frame(Preprocess(), raw, View(view.box))
        np.testing.assert_array_equal(prepare_frame(Preprocess(), raw, view), alone)


@pytest.mark.parametrize(
    "convert",
    [
        lambda image: image,
        lambda image: image > 0,
        lambda image: image // 255,
        lambda image: np.minimum(image, 100),
        lambda image: np.clip(image, 8, 246),
    ],
    ids=["uint8", "bool", "zero_one", "grey", "jpeg"],
)
def test_a_binary_frame_is_not_thresholded_again(frames, convert):
    image = np.asarray(binarise(Preprocess(size=128), frames[0]))
    np.testing.assert_array_equal(prepare_frame(Preprocess(size=128), convert(image)), image)


@pytest.mark.parametrize("kind", [bool, np.uint8])
@pytest.mark.parametrize("size", [48, 96])
@pytest.mark.parametrize("box", [None, (3, 5, 67, 69), (-70, -70, 5, 5)], ids=str)
def test_the_quick_way_for_black_and_white_gives_what_the_long_one_does(kind, size, box):
    generator = np.random.default_rng(size)
    for shape in ((96, 96), (64, 96)):
        raw = generator.random(shape) > 0.7
        raw = raw if kind is bool else raw.astype(np.uint8) * np.uint8(255)
        wider = raw.astype(np.float32 if kind is bool else np.uint16)  # goes the long way
        assert grey.find_white_pixels(raw) is not None
        quick, long = (
            prepare_frame(Preprocess(size=size), each, View(box)) for each in (raw, wider)
        )
        assert quick.dtype == long.dtype == np.uint8
        np.testing.assert_array_equal(quick, long)


def test_a_binary_frame_of_another_framing_is_brought_to_ours(frames):
    image = np.asarray(binarise(Preprocess(size=512), frames[0]))
    found = detect_pin_centres(prepare_frame(Preprocess(size=256), image[50:-50, 50:-50]))
    assert abs(len(found) - 331) <= 1
    assert np.hypot(*(found - 127.5).T).max() / 256 == pytest.approx(OUTER, abs=0.015)


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (np.full((64, 64), np.nan), "not finite"),
        (np.zeros((0, 0)), "too small"),
        (np.zeros((4, 300)), "too small"),
        (np.zeros((64, 64, 7)), "shape"),
        (np.zeros(64), "shape"),
        (np.array([["a"] * 32] * 32), "type"),
        (np.zeros((64, 64), np.uint8), "flat"),
        (np.full((64, 64, 3), 255, np.uint8), "flat"),
    ],
    ids=["nan", "empty", "thin", "channels", "line", "text", "black", "white"],
)
def test_what_is_no_image_is_refused(raw, says):
    with pytest.raises(UserError, match=says):
        prepare_frame(Preprocess(), raw)


@pytest.mark.parametrize("number", [1, 2, 3])
@SIZES
def test_real_frames(real_recordings, number, size):
    raw = np.asarray(Image.open(real_recordings / "raw" / f"image_{number}.png"))
    preprocess, grey = Preprocess(size=size), to_grey(raw)
    square = crop_frame(grey, find_dome(grey, preprocess.outer_pins))
    image = prepare_frame(preprocess, raw)
    for each in (image, binarise(preprocess, square)):
        check_agreement(preprocess, each, square)
    found = detect_pin_centres(image)
    assert abs(len(found) - 331) <= 3
    outermost = np.sort(np.hypot(*(found - found.mean(0)).T))[-60:].mean() / size
    assert outermost == pytest.approx(OUTER, abs=0.01)


@pytest.mark.parametrize("grey", [False, True])
def test_dots_on_one_line_and_stripes_are_no_outline(grey):
    """Nothing to fit a circle to: the middle of the frame, as without any dots."""
    row, stripes = np.zeros((2, 256, 256), np.uint8)
    for left in range(9, 250, 9):
        row[100:105, left : left + 5] = 255
    stripes[:, ::8] = stripes[:, 1::8] = 255
    for raw in (row, stripes):
        raw = 40 + raw // 2 + (np.arange(256)[:, None] // 8).astype(np.uint8) if grey else raw
        assert prepare_frame(Preprocess(size=64), raw).shape == (64, 64)


def test_dots_on_a_shallow_arc_are_not_taken_for_a_dome_of_a_hundred_thousand_pixels():
    image = np.zeros((1000, 1000), np.uint8)
    for left in range(20, 980, 24):
        top = round(500 + 3 * ((left - 500) / 480) ** 2)
        image[top : top + 7, left : left + 7] = 255
    assert _frame_pins(image / 255, 0.36) == (0, 0, 1000, 1000)
