"""Streams: a line a frame, bad frames skipped and counted, late ones dropped, never a traceback."""

import base64
import io
import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxunshear.apps.robot import frame_sources
from jaxunshear.apps.robot.frame_sources import open_source, read_newest
from jaxunshear.apps.robot.source_frame import SourceFrame, SourceLostError
from jaxunshear.apps.robot.stream import INLINE, Outputs, stream
from jaxunshear.config.load import load_experiment
from jaxunshear.config.sensor import Preprocess
from jaxunshear.data import videos
from jaxunshear.data.recordings import PROBES, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.files import write_json
from jaxunshear.inference.forward import UNSHEARED
from jaxunshear.inference.readers import ImageReader, Predictions, make_steady_view
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.sensor_check import FOREIGN_REASON, UNIDENTIFIED_REASON
from jaxunshear.perception.touch import Touch

EXPERIMENT = load_experiment("experiments/tiny.py")


def dots(seed=0, size=128):
    return (np.random.default_rng(seed).random((size, size)) < 0.2).astype(np.uint8) * 255


class StandIn(TrainedModel):
    """A model that unshears nothing; its networks take `seconds`."""

    seconds = 0.0

    def predict(self, images):
        time.sleep(self.seconds)
        poses = {UNSHEARED: {"edge_mm": np.array([0.25]), "edge_deg": np.array([-3.0])}}
        touch = Touch(*np.full((len(Touch._fields), 1), 0.5))
        return Predictions(
            images / 255.0, poses, {}, np.array([""]), np.array([0.9]), lambda: touch
        )


def run(frames, live=False, seconds=0.0, images=None, is_filtered=False, force=False):
    out, model = io.StringIO(), StandIn(Path("nowhere"), EXPERIMENT, force=force)
    model.seconds, model.targets = seconds, ("edge_mm", "edge_deg")
    summary = stream(iter(frames), live, model, Outputs(out, images, is_filtered))
    return summary, read_lines(out)


def read_lines(out):
    return [json.loads(line) for line in out.getvalue().splitlines()]


def make_frames(*pixels):
    """Number frames by their place, which is also their name."""
    return [SourceFrame(number, str(number), each) for number, each in enumerate(pixels)]


def test_a_line_a_frame_with_image_pose_and_confidence():
    summary, lines = run(make_frames(dots(), dots(1)), images=INLINE)
    assert (summary.used, summary.skipped, summary.dropped) == (2, 0, 0)
    assert (
        lines[0]["pose"]["edge_mm"] == 0.25 and lines[0]["confidence"] == 0.9 and lines[0]["ms"] > 0
    )
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(lines[1]["image_png"]))))
    assert image.shape == (128, 128) and image.max() == 255
    assert summary.latency_ms["p50"] <= summary.latency_ms["p99"]


def test_bad_frames_are_reported_and_skipped():
    torn = SourceFrame(1, "torn", None, "no readable image")
    flat, small = np.full((64, 64), 7, np.uint8), np.zeros((4, 4), np.uint8)
    nan, five_channels = np.full((64, 64), np.nan), np.zeros((64, 64, 5), np.uint8)
    first, *others = make_frames(dots(), flat, small, nan, five_channels, dots(3))
    summary, lines = run([first, torn, *others])
    assert (summary.used, summary.skipped) == (2, 5)
    assert [("error" in line) for line in lines] == [False, *[True] * 5, False]
    assert sum(summary.problems.values()) == 5


def test_a_frame_that_is_not_understood_has_no_pose_and_enters_no_mean():
    """One is noise, another has no identified pins; with `force` only the latter is refused."""
    model = TrainedModel(Path("nowhere"), EXPERIMENT)
    rest, size = np.float32(model.lattice.rest), model.preprocess.size
    offset = rest - rest.mean(axis=0)
    pressed = rest + 0.1 * offset * np.exp(-np.square(offset).sum(-1) / 600)[:, None]
    pins = np.uint8(255 * np.asarray(draw_dots(pressed[None], 1.5, size))[0, ..., 0] + 0.5)
    model.targets = ("edge_mm",)
    model._forward = lambda values: (values, {UNSHEARED: {"edge_mm": np.array([0.25])}})

    def answer(force):
        model.force, out = force, io.StringIO()
        identified = iter(([True], [True], [False]))
        model.reader = ImageReader()
        read = model.reader.read
        model.reader.read = lambda images: read(images)._replace(
            identified=np.array(next(identified))
        )
        frames = iter(make_frames(pins, dots(), pins))
        true = lambda number: {"edge_mm": 0.25 - number}  # noqa: E731
        return stream(frames, False, model, Outputs(out, read_labels=true)), read_lines(out)

    summary, lines = answer(False)
    assert (summary.used, summary.skipped) == (1, 2)
    assert summary.problems == {FOREIGN_REASON: 1, UNIDENTIFIED_REASON: 1}
    assert lines[0]["confidence"] > 0.5 and summary.pose_mae == {"edge_mm": 0}
    for line, reason in zip(lines[1:], (FOREIGN_REASON, UNIDENTIFIED_REASON), strict=True):
        common = {"schema", "frame", "name", "time_s", "confidence", "error", "ms"}
        assert line.keys() - {"touch"} == common
        assert (line["confidence"], line["error"]) == (0, reason)
    summary, lines = answer(True)
    assert (summary.used, summary.problems) == (2, {UNIDENTIFIED_REASON: 1})
    assert lines[1]["confidence"] < 0.01


@pytest.mark.parametrize("channels", [(), (1,), (3,), (4,)])
def test_greys_of_a_camera_are_not_mirrored_and_colours_are_red_green_blue(channels):
    pixels = np.random.default_rng(0).integers(0, 255, (40, 60, *channels), dtype=np.uint8)
    expected = pixels[..., 2::-1] if channels in ((3,), (4,)) else pixels
    np.testing.assert_array_equal(videos.order_colours(pixels), expected)


def test_a_video_is_streamed_and_a_damaged_one_refused_in_silence(tmp_path, capfd):
    cv2 = videos.import_opencv()  # first, since it decides what OpenCV prints
    video = tmp_path / "touch.avi"
    grey = np.zeros((120, 160), np.uint8)
    grey[:, :80] = 255
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10, (160, 120))
    for _ in range(4):
        writer.write(np.stack([grey, grey // 2, 0 * grey], -1))  # blue, green, red
    writer.release()
    source = open_source(str(video), Preprocess())
    shown = list(source.frames)
    assert not source.is_live and [frame.name for frame in shown] == [f"{n:06d}" for n in range(4)]
    np.testing.assert_allclose([frame.time_s for frame in shown], [0, 0.1, 0.2, 0.3], atol=0.02)
    left, right = shown[0].pixels[:, :70], shown[0].pixels[:, 90:]
    np.testing.assert_allclose(left.mean(axis=(0, 1)), [0, 127, 255], atol=6)  # red, green, blue
    np.testing.assert_allclose(right.mean(axis=(0, 1)), 0, atol=6)
    summary, lines = run(open_source(str(video), Preprocess()).frames)
    assert summary.used == len(lines) == 4
    (tmp_path / "torn.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + b"x" * 500)
    with pytest.raises(UserError, match="cannot be read as a video"):
        open_source(str(tmp_path / "torn.mp4"), Preprocess())
    assert capfd.readouterr() == ("", "")


def test_the_page_names_every_field(tmp_path):
    """In lines that have all there can be, and none that there cannot."""
    half_widths = {"unsheared": {"edge_mm": 0.5, "edge_deg": 9.0}}
    write_json(tmp_path / "results.json", {"half_width": half_widths})
    fields = set()
    for images in (INLINE, tmp_path / "out"):
        out, model = io.StringIO(), StandIn(tmp_path, EXPERIMENT)
        model.targets = ("edge_mm", "edge_deg")
        frames = [frame._replace(time_s=0.1) for frame in make_frames(dots(), np.zeros((9, 9)))]
        outputs = Outputs(out, images, True, lambda number: {"edge_mm": 0.0})
        stream(iter(frames), False, model, outputs)
        good, bad = read_lines(out)
        fields |= good.keys() | bad.keys()
        assert good["half_width"] == half_widths["unsheared"]
        assert good["label_error"] == {"edge_mm": 0.25}
    _, table = Path("docs/stream.md").read_text().split("| field | what it is | there |")
    first = [row.split("|")[1] for row in table.split("\n\n")[0].splitlines()[2:]]
    assert fields == set(re.findall(r"`(\w+)`", " ".join(first)))


def test_a_slow_robot_sees_the_newest_frame_and_the_rest_are_dropped():
    live = read_newest(frame_sources._play(make_frames(*[dots()] * 40), fps=200), "a folder")
    summary, lines = run(live, live=True, seconds=0.03)
    assert summary.dropped > 10 and summary.used + summary.dropped == 40
    shown = [line["frame"] for line in lines]
    assert shown[-1] == 39 and shown == sorted(shown)


def break_off(end):
    yield SourceFrame(0, "a", dots())
    raise end


def test_a_problem_in_the_reading_thread_is_reported():
    with pytest.raises(UserError, match="camera 0 gave no frame"):
        list(read_newest(break_off(UserError("camera 0 gave no frame")), "camera:0"))


def test_folders_are_read_in_order_with_torn_files_among_them(tmp_path):
    for number in (1, 2, 10):
        Image.fromarray(dots(number)).save(tmp_path / f"image_{number}.png")
    (tmp_path / "image_3.png").write_bytes(b"\x89PNG torn")
    source = open_source(str(tmp_path), Preprocess())
    listed = list(source.frames)
    assert not source.is_live and not source.has_times
    assert [frame.name for frame in listed] == [f"image_{n}.png" for n in (1, 2, 3, 10)]
    assert listed[2].pixels is None and listed[2].problem


@pytest.mark.parametrize("end", [KeyboardInterrupt(), SourceLostError("camera:0 gave no frame")])
def test_a_camera_ends_by_a_key_or_a_pulled_plug_with_its_summary(end):
    summary, lines = run(break_off(end), live=True)
    assert summary.used == len(lines) == 1 and summary.latency_ms
    assert summary.lost == str(end) * isinstance(end, UserError)


def test_an_end_that_is_none_is_raised():
    for end in (KeyboardInterrupt(), UserError("damaged")):
        with pytest.raises(type(end)):
            run(break_off(end), live=False)


def disc(middle, size=240):
    """Make a dark dome in a light surround, with something in it."""
    row, column = np.mgrid[:size, :size]
    inside = np.hypot(row - size / 2, column - middle) < 80
    return np.where(inside, 40 + (row + column) % 9 * 4, 230).astype(np.uint8)


def test_the_crop_of_a_camera_comes_to_rest():
    """The median of the first frames' own: what comes later is not followed."""
    seen = make_steady_view(Preprocess(size=128))
    own = [seen(disc(120 + 4 * (number % 3 - 1))).box for number in range(PROBES)]
    assert len(set(own)) > 1
    later = {seen(disc(middle)).box for middle in (100, 120, 140)}
    assert later == {own[-1]} and abs((own[-1][0] + own[-1][2]) / 2 - 120) < 3
    assert seen(disc(120, 250)).box != own[-1]  # another size: another camera
    assert seen(disc(140)).box == own[-1]
    with pytest.raises(UserError, match="flat grey"):
        make_steady_view(Preprocess())(np.zeros((64, 64), np.uint8))


def test_frames_of_a_folder_are_cropped_as_elsewhere(tmp_path):
    preprocess = Preprocess(size=128)
    for number, middle in enumerate((110, 120, 130)):
        Image.fromarray(disc(middle)).save(tmp_path / f"{number}.png")
    frames, *_ = open_source(str(tmp_path), preprocess)
    expected = read_recordings(tmp_path, preprocess).find_common_view()
    assert {frame.view for frame in frames} == {expected}
