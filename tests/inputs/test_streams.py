"""Frames as cameras, videos and other programs give them."""

import contextlib
import io
import json
import os
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear.apps.robot import cameras, frame_sources
from jaxunshear.apps.robot.messages import HEADER, TIME
from jaxunshear.config.data import Ranges
from jaxunshear.config.targets import make_range_targets
from jaxunshear.data.recorded_contacts import compute_digest
from jaxunshear.data.sensor_frame import parse_frame
from jaxunshear.data.videos import import_opencv
from jaxunshear.inference import trained_model
from tests.helpers.image_files import png_of
from tests.helpers.models import write_pin_weights
from tests.inputs.cases import Case, run_each
from tests.recordings import made

TARGETS = make_range_targets(("edge_mm", "depth_mm"), Ranges())
COUNT = 20  # frames of the folder
PATIENCE = 0.4  # s, in the place of seconds


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A folder of contacts, and a model that is like them."""
    place = tmp_path_factory.mktemp("streams")
    folder = made.write(place / "edge", *made.contacts(COUNT, False, 0))
    files = [folder / "images" / f"image_{number + 1}.png" for number in range(COUNT)]
    weights = write_pin_weights(place, TARGETS, made.rest_px(), made.SIZE)
    frames = [np.array(Image.open(file)) for file in files]
    return SimpleNamespace(
        folder=folder,
        weights=weights,
        frames=frames,
        model=trained_model.load_model(weights, folder),
    )


class Door:
    """What a case is given: frames, and commands whose model is loaded once."""

    def __init__(self, shared, command, monkeypatch, absent, tmp_path):
        self.frames, self.folder, self.weights = shared.frames, shared.folder, shared.weights
        self.model = shared.model
        self.command, self.absent, self.patch, self.path = command, absent, monkeypatch, tmp_path

        def load(name, like=None, force=False):
            shared.model.force = force
            return shared.model

        monkeypatch.setattr(trained_model, "load_model", load)
        monkeypatch.setattr("jaxunshear.inference.infer.load_model", load)
        waits = (PATIENCE, 2 * PATIENCE)
        monkeypatch.setattr(frame_sources.read_newest, "__defaults__", waits)
        monkeypatch.setattr(frame_sources, "LIST_PATIENCE_S", PATIENCE)

    def stream(self, source, *words):
        """Return exit code, what stderr says, and the lines."""
        answer = self.command("stream", source, "--model", self.weights, *words)
        lines = [json.loads(line) for line in answer.out.splitlines() if line.startswith("{")]
        return answer.code, answer.err, lines

    def poses(self):
        """Those of the folder's frames, edge_mm."""
        return [line["pose"]["edge_mm"] for line in self.stream(self.folder)[2]]

    def plug(self, *script, **settings):
        """Plug in cameras that give what `script` has: frames, None for a failed read, or ends."""
        fake = FakeOpenCV(script, **settings)
        self.patch.setattr(cameras, "import_opencv", lambda: fake)
        return fake

    def refuses(self, reason, source, *words):
        code, said, lines = self.stream(source, *words)
        assert (code, lines) == (2, []) and reason in said
        assert len(said.strip().splitlines()) == 1 and "Traceback" not in said

    def write_video(self, name="touch.avi", count=COUNT):
        """Write a video without loss; names of its frames are 000000 and so on."""
        cv2 = import_opencv()
        file = self.path / name
        size = self.frames[0].shape[::-1]
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"FFV1"), 10, size)
        for frame in self.frames[:count]:
            writer.write(np.stack([frame] * 3, -1))
        writer.release()
        return file


class FakeOpenCV:
    """OpenCV with one camera. Every version that the extra allows has what is used of it here."""

    def __init__(self, script, properties=(), refused=(), busy=(), hangs=False, build=""):
        self.script, self.properties, self.refused = list(script), dict(properties), refused
        self.busy, self.hangs, self.build, self.opened, self.released = busy, hangs, build, [], 0
        self.free = threading.Event()

    def VideoCapture(self, *device):  # noqa: N802
        self.opened.append(device)
        if self.hangs:
            self.free.wait(10)
        return self

    def getBuildInformation(self):  # noqa: N802
        return self.build

    def isOpened(self):  # noqa: N802
        return self.opened[-1][0] not in self.busy

    def get(self, key):
        return self.properties.get(key, 0.0)

    def set(self, key, value):
        if key in self.refused:
            return False
        self.properties.setdefault(key, value)
        return True

    def read(self):
        time.sleep(0.02)  # 50 frames per s
        now = self.script.pop(0) if self.script else None
        if isinstance(now, BaseException):
            raise now
        if callable(now):
            now = now()
        return (now is not None), now

    def release(self):
        self.released += 1


END = KeyboardInterrupt()  # as a person ends a camera


def twice(frame):
    return np.repeat(np.repeat(frame, 2, 0), 2, 1)


def widen(frame):
    return np.pad(frame, ((0, 0), (16, 16)))


def save(frames, folder):
    folder.mkdir()
    for number, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"{number:03d}.png")
    return folder


def check_folder(door):
    code, _, lines = door.stream(door.folder)
    assert code == 0 and [line["frame"] for line in lines] == list(range(COUNT))
    fields = {"schema", "frame", "name", "time_s", "confidence", "touch", "pose", "ms"}
    assert all(line.keys() == fields for line in lines)
    assert {line["time_s"] for line in lines} == {None} and lines[0]["schema"] == 1


def check_twice_the_size(door):
    code, said, lines = door.stream(save(map(twice, door.frames), door.path / "large"))
    assert code == 0, said
    # edges of dots differ by how they are resampled
    np.testing.assert_allclose([line["pose"]["edge_mm"] for line in lines], door.poses(), atol=0.15)


def check_twice_the_size_as_pose(door):
    folder = save(map(twice, door.frames), door.path / "large")
    answer = door.command("pose", folder, "--model", door.weights, "--like", door.folder)
    assert answer.code == 0 and f"poses of {COUNT} images, 0 left out" in answer.err
    head, *rows = (line.split(",") for line in answer.out.splitlines())
    poses = [float(row[head.index("unsheared_edge_mm")]) for row in rows]
    np.testing.assert_allclose(poses, door.poses(), atol=0.15)


def check_stored_crop(door):
    frame = door.model.frame
    stored = json.loads(json.dumps(frame.describe()))
    assert frame.view.frame_px == (made.SIZE, made.SIZE)
    assert parse_frame(stored).view == frame.view


def check_another_shape(door):
    code, said, lines = door.stream(save(map(widen, door.frames), door.path / "wide"))
    assert code == 1 and "96 x 96" in said and "128 x 96" in said
    assert all("pose" not in line and line["confidence"] == 0 for line in lines)


def check_camera(door):
    camera = door.plug(*door.frames[:5], END)
    before = time.time()
    code, said, lines = door.stream("camera:3")
    assert code == 0, said
    assert camera.opened == [(3,)] and camera.released == 1
    assert all(before < line["time_s"] < time.time() and "pose" in line for line in lines)


def check_camera_grows(door):
    frames = door.frames[:4] + [twice(frame) for frame in door.frames[4:8]]
    door.plug(*frames, END)
    code, _, lines = door.stream("camera")
    poses = door.poses()
    assert code == 0 and lines[-1]["frame"] > 4
    for line in lines:
        assert line["pose"]["edge_mm"] == pytest.approx(poses[line["frame"]], abs=0.15)


def check_camera_widens(door):
    door.plug(*door.frames[:3], *[widen(frame) for frame in door.frames[:12]], END)
    code, said, lines = door.stream("camera")
    assert code == 1 and "128 x 96" in said and "96 x 96" in said
    assert "pose" not in lines[-1] and lines[-1]["confidence"] == 0


def check_camera_hangs(door):
    start, free = time.monotonic(), threading.Event()
    camera = door.plug(*door.frames[:3], lambda: free.wait(5))
    code, said, lines = door.stream("camera:0")
    assert (code, camera.released) == (1, 0) and "camera:0 gave no frame for 0.4 s" in said
    assert lines and time.monotonic() - start < 4
    free.set()


def check_camera_never_opens(door):
    camera = door.plug(hangs=True)
    code, said, lines = door.stream("camera:0")
    assert (code, lines) == (1, []) and "camera:0 gave no frame for 0.8 s" in said
    camera.free.set()


def check_camera_is_pulled(door):
    camera = door.plug(*door.frames[:5], *[None] * 10_000)
    code, said, lines = door.stream("camera:0")
    assert (code, camera.released) == (1, 1) and "gave no frame" in said and lines


def check_camera_raises(door):
    door.plug(*door.frames[:3], *[RuntimeError("v4l2: error")] * 10_000)
    code, said, lines = door.stream("camera:0")
    assert code == 1 and "gave no frame" in said and "Traceback" not in said and lines


def check_no_number(door):
    predict = door.model.predict

    def overflow(images):
        found = predict(images)
        return found._replace(poses={"unsheared": {"edge_mm": np.array([np.inf])}})

    door.patch.setattr(door.model, "predict", overflow)
    code, said, lines = door.stream(door.folder)
    assert code == 1 and "no finite pose" in said
    assert all("pose" not in line and line["confidence"] == 0 for line in lines)


def check_camera_stutters(door):
    door.plug(*door.frames[:3], *[None] * 5, *door.frames[3:6], END)
    code, _, lines = door.stream("camera:0")
    assert code == 0 and lines[-1]["frame"] == 5


def stand_still(door, frame, *words):
    """Stream a frame, then another one for 2.4 s."""
    times = np.arange(25) / 10
    frames = [door.frames[0], *[frame] * 24]
    give_stdin(door, b"".join(map(pack, frames, times)))
    return door.stream("-", *words)


def check_frozen(door):
    grey = door.frames[1].copy()
    grey[0, 0] = 1  # no longer of two levels
    code, said, lines = stand_still(door, grey)
    assert code == 1 and "skipped 13: the picture is frozen" in said
    assert ["pose" in line for line in lines] == [True] * 12 + [False] * 13
    assert lines[-1]["confidence"] == 0
    code, said, lines = stand_still(door, grey, "--force")
    assert code == 0 and "frozen" not in said and "pose" in lines[-1]


def check_still_binary(door):
    code, said, lines = stand_still(door, door.frames[1])
    assert code == 0 and "frozen" not in said and "pose" in lines[-1]


def check_gstreamer(door):
    pipeline = f"v4l2src device=/dev/video2 ! {'videoconvert ! ' * 30}appsink"
    camera = door.plug(*door.frames[:2], END, build="    GStreamer:      YES (1.24.2)")
    assert door.stream(pipeline)[0] == 0 and camera.opened == [(pipeline, 1800)]
    door.plug(busy=(pipeline,), build="    GStreamer:      NO")
    door.refuses("built without GStreamer", pipeline)


def check_addresses(door):
    camera = door.plug(*door.frames[:2], END)
    assert door.stream("rtsp://camera.local/touch")[0] == 0
    assert camera.opened == [("rtsp://camera.local/touch",)]
    door.plug(busy=("http://camera.local",))
    door.refuses("cannot be opened: is it plugged in, and free?", "http://camera.local")


def check_settings(door):
    height, width = door.frames[0].shape
    camera = door.plug(*door.frames[:2], END)
    asked = ("--size", f"{width}x{height}", "--fps", 50, "--exposure", 20)
    assert door.stream("camera:0", *asked)[0] == 0
    assert camera.properties == {3: width, 4: height, 5: 50, 15: 20, 21: 1}


def check_size_not_given(door):
    door.plug(*door.frames[:2], END)
    door.refuses("camera:0 gives 96 x 96 px, not --size 640x480", "camera:0", "--size", "640x480")


def check_list(door):
    door.patch.setattr(frame_sources, "find_devices", lambda: [0, 2, 4])
    door.patch.setattr(frame_sources, "describe_device", lambda number: f"Eye {number}")
    door.plug(*door.frames[:3], busy=(2,))
    answer = door.command("stream", "list")
    rows = answer.out.splitlines()
    assert answer.code == 0 and rows[0] == "camera:0  96 x 96 px  Eye 0"
    assert rows[1].startswith("camera:2  gives no picture") and len(rows) == 3
    door.patch.setattr(frame_sources, "find_devices", list)
    answer = door.command("stream", "list")
    assert (answer.code, answer.out) == (1, "no camera is plugged in\n")


def check_no_opencv(door):
    video = door.path / "touch.mp4"
    video.write_bytes(b"a video")
    door.absent("cv2")
    for words in (("doctor",), ("pins",), ("pose",), ("stream",)):
        answer = door.command(*words, video)
        assert answer.code == 2 and "the extra `camera`: pip install" in answer.err
    door.refuses("the extra `camera`", "camera:0")


def check_video_as_stream(door):
    code, said, lines = door.stream(door.write_video())
    assert code == 0, said
    assert [line["pose"]["edge_mm"] for line in lines] == pytest.approx(door.poses(), abs=2e-3)
    assert [line["time_s"] for line in lines] == pytest.approx(np.arange(COUNT) / 10, abs=0.01)


def check_video_as_pose(door):
    answer = door.command("pose", door.write_video(), "--model", door.weights)
    assert answer.code == 0 and f"poses of {COUNT} images" in answer.err
    head, *rows = (line.split(",") for line in answer.out.splitlines())
    poses = [float(row[head.index("unsheared_edge_mm")]) for row in rows]
    assert poses == pytest.approx(door.poses(), abs=2e-3)


def check_video_as_unshear(door):
    answer = door.command(
        *("unshear", door.write_video(), "--model", door.weights, "--out", door.path / "out")
    )
    assert answer.code == 0 and len(list((door.path / "out").glob("*.png"))) == COUNT


def check_video_as_pins(door):
    words = ("--sensor", "tactip127", "--out", door.path / "out")
    answer = door.command("pins", door.write_video(), *words)
    assert answer.code == 0, answer.err
    assert f"{COUNT}" in answer.out and (door.path / "out" / "pins.csv").is_file()


def check_video_as_doctor(door):
    answer = door.command("doctor", door.write_video())
    assert answer.code == 0 and f"{COUNT}" in answer.out and "127" in answer.out


def check_folder_of_videos(door):
    door.write_video("a.avi")
    door.write_video("b.avi", 3)
    (door.path / "torn.avi").write_bytes(b"RIFF torn")
    code, said, lines = door.stream(door.path)
    assert code == 0, said
    names = [line["name"] for line in lines]
    assert names[0] == "a.avi/000000" and names[-3:] == [f"b.avi/{n:06d}" for n in range(3)]
    digest = compute_digest((str(door.path),))
    door.write_video("b.avi", 4)
    assert compute_digest((str(door.path),)) != digest


def check_cut_video(door):
    video = door.write_video()
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    code, said, lines = door.stream(video)
    assert "breaks off" in lines[-1]["error"] and "breaks off" in said and "pose" in lines[0]


def pack(frame, time_s=12.5):
    data = png_of(frame)
    return HEADER.pack(len(data), time_s) + data


def check_stdin(door):
    file = io.BytesIO()
    np.save(file, door.frames[1])
    array = HEADER.pack(len(file.getvalue()), float("nan")) + file.getvalue()
    give_stdin(door, pack(door.frames[0]) + array + pack(door.frames[2], 13.5))
    before = time.time()
    code, _, lines = door.stream("-")
    assert code == 0 and [line["frame"] for line in lines] == [0, 1, 2]
    assert [line["pose"]["edge_mm"] for line in lines] == pytest.approx(door.poses()[:3], abs=2e-3)
    assert (lines[0]["time_s"], lines[2]["time_s"]) == (12.5, 13.5)
    assert before <= lines[1]["time_s"] <= time.time()


def give_stdin(door, data):
    door.patch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(data)))


def check_stdin_cut(door):
    give_stdin(door, pack(door.frames[0]) + pack(door.frames[1])[:-20])
    code, said, lines = door.stream("-")
    assert (code, len(lines)) == (1, 1) and "stdin breaks off within frame 1" in said


def check_stdin_form(door):
    give_stdin(door, png_of(door.frames[0]))
    door.refuses("each frame is struct.pack('!Id', length, time)", "-")


def check_stdin_no_image(door):
    give_stdin(door, HEADER.pack(4, 1.0) + b"none" + pack(door.frames[0]) * 2)
    code, _, lines = door.stream("-")
    assert code == 0 and "this frame is no image" in lines[0]["error"] and "pose" in lines[1]


@contextlib.contextmanager
def serve(data, closes=True):
    """Give `data` to who connects, then close, or keep silent."""
    done = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            connection, _ = server.accept()
            with connection:
                connection.sendall(data)
                done.wait(0 if closes else 5)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        done.set()
        thread.join(1)


def check_tcp(door):
    with serve(pack(door.frames[0])) as address:
        code, _, lines = door.stream(address)
    assert code == 0 and lines[-1]["pose"]["edge_mm"] == pytest.approx(door.poses()[0], abs=2e-3)


def check_tcp_silent(door):
    with serve(pack(door.frames[0]), closes=False) as address:
        code, said, lines = door.stream(address)
    assert (code, len(lines)) == (1, 1) and f"{address} gave no frame" in said


def check_zmq(door):
    zmq = pytest.importorskip("zmq")
    publisher = zmq.Context.instance().socket(zmq.PUB)
    port, stopped = publisher.bind_to_random_port("tcp://127.0.0.1"), threading.Event()

    def publish():
        for count in range(400):
            if stopped.wait(0.02):
                break
            publisher.send_multipart([TIME.pack(float(count)), png_of(door.frames[count % COUNT])])
        publisher.close(0)

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    timer = threading.Timer(1.0, stopped.set)
    timer.start()
    code, said, lines = door.stream(f"zmq:tcp://127.0.0.1:{port}")
    thread.join(2)
    assert code == 1 and "gave no frame" in said  # the publisher stopped
    poses = door.poses()
    for line in lines:
        expected = poses[int(line["time_s"]) % COUNT]
        assert line["pose"]["edge_mm"] == pytest.approx(expected, abs=2e-3)
    assert len(lines) > 3


def check_no_zmq(door):
    door.absent("zmq")
    door.refuses("the extra `zmq`: pip install", "zmq:tcp://127.0.0.1:5555")


def check_pictures(door):
    _, _, lines = door.stream(door.folder, "--images", "-")
    assert all("image_png" in line for line in lines)
    _, _, lines = door.stream(door.folder, "--images", door.path / "out")
    assert os.path.isfile(lines[0]["image"]) and "image_png" not in lines[0]


def check_filter(door):
    code, _, lines = door.stream(door.write_video(), "--filter")
    assert code == 0
    assert all(
        line["filtered"].keys() == line["rate"].keys() == line["pose"].keys() for line in lines
    )
    first, *_, last = lines
    assert first["filtered"] == first["pose"] and last["filtered"] != last["pose"]


REFUSALS = (
    ("camera:²", "a digit that is none", "use camera:N", ()),
    ("camera:-1", "a number below zero", "use camera:N", ()),
    ("camera:usb", "a camera by another name", "use camera:N", ()),
    ("/dev/video77", "the path of a camera that is not there", "/dev/video77 does not exist", ()),
    ("camera:/dev/video77", "the same after camera:", "/dev/video77 does not exist", ()),
    ("tcp://robot", "an address without a port", "use tcp://HOST:PORT", ()),
    ("tcp://127.0.0.1:1", "a port where nobody listens", "Connection refused", ()),
    ("zmq:robot", "an endpoint that is none", "use zmq:tcp://HOST:PORT", ()),
    ("camera:0", "a size in one number", "--size 640: use width x height", ("--size", "640")),
    ("camera:0", "a rate of nought", "--fps 0: use more than 0", ("--fps", "0")),
    ("camera:0", "an exposure that is none", "--exposure nan: use a", ("--exposure", "nan")),
    ("FOLDER", "a size of a folder", "are of a camera", ("--size", "640x480")),
    ("FOLDER", "an exposure of a folder", "are of a camera", ("--exposure", "3")),
    ("-", "a size of stdin", "are of a camera", ("--size", "640x480")),
    ("tcp://127.0.0.1:1", "a rate of a sender", "--fps is of a camera or files", ("--fps", "9")),
    ("FOLDER", "a filter without times", "--filter needs times", ("--filter",)),
)


def refuse(source, reason, words):
    return lambda door: door.refuses(reason, door.folder if source == "FOLDER" else source, *words)


CASES = [
    Case("a folder", "stream", "a line each, with the fields of the schema", check_folder),
    Case("frames twice as large as those of --like", "stream", "scaled", check_twice_the_size),
    Case("frames twice as large as of --like", "pose", "scaled", check_twice_the_size_as_pose),
    Case("a crop as a run stores it", "Python", "knows its frames' size", check_stored_crop),
    Case("frames wider than those of --like", "stream", "both sizes, 1", check_another_shape),
    Case("a camera by number", "stream", "poses and times", check_camera),
    Case("a camera that doubles its size", "stream", "scaled", check_camera_grows),
    Case("a camera that changes its shape", "stream", "both sizes, 1", check_camera_widens),
    Case("a camera that hangs", "stream", "lost after a time, 1", check_camera_hangs),
    Case("a camera that never opens", "stream", "lost after a time, 1", check_camera_never_opens),
    Case("a camera that is pulled out", "stream", "lost after a time, 1", check_camera_is_pulled),
    Case("a camera whose reads raise errors", "stream", "lost, 1", check_camera_raises),
    Case("networks that overflow", "stream", "a reason, no pose, 1", check_no_number),
    Case("a camera that misses some frames", "stream", "goes on", check_camera_stutters),
    Case("a picture that is frozen", "stream", "said, no pose, 1", check_frozen),
    Case("binary images that stay the same", "stream", "poses", check_still_binary),
    Case("a pipeline of GStreamer", "stream", "opened, or no GStreamer, 2", check_gstreamer),
    Case("a camera by URL", "stream", "opened, or refused, 2", check_addresses),
    Case("size, rate and exposure", "stream", "set", check_settings),
    Case("a size that the camera lacks", "stream", "both sizes, 2", check_size_not_given),
    Case("cameras, one busy, or none", "stream list", "listed; 1 for none", check_list),
    Case("videos and cameras without OpenCV", "all", "the extra, 2", check_no_opencv),
    Case("a video", "stream", "poses of its frames, and their times", check_video_as_stream),
    Case("a video", "pose", "poses of its frames", check_video_as_pose),
    Case("a video", "unshear", "an image for each frame", check_video_as_unshear),
    Case("a video", "pins", "pins of its frames", check_video_as_pins),
    Case("a video", "doctor", "frames and sensor", check_video_as_doctor),
    Case("a folder of videos, one torn", "stream", "frames of the others", check_folder_of_videos),
    Case("a video cut in half", "stream", "its frames, then where it breaks off", check_cut_video),
    Case("PNG and NPY on stdin", "stream", "each is answered", check_stdin),
    Case("stdin that breaks off", "stream", "lost within a frame, 1", check_stdin_cut),
    Case("a file on stdin without headers", "stream", "the form, 2", check_stdin_form),
    Case("a message that is no image", "stream", "a reason; the next follow", check_stdin_no_image),
    Case("frames over TCP", "stream", "poses until it closes", check_tcp),
    Case("a connection that falls silent", "stream", "lost after a time, 1", check_tcp_silent),
    Case("frames over ZeroMQ", "stream", "poses with the sender's times", check_zmq),
    Case("ZeroMQ without pyzmq", "stream", "the extra, 2", check_no_zmq),
    Case("pictures asked for", "stream", "in the lines, or in a folder", check_pictures),
    Case("a filter over a video", "stream", "smoothed poses and rates", check_filter),
    *(
        Case(f"{name}: {source}", "stream", "refused, 2", refuse(source, reason, words))
        for source, name, reason, words in REFUSALS
    ),
]


@run_each(CASES)
def test_streams(case, shared, command, monkeypatch, absent, tmp_path):
    case.check(Door(shared, command, monkeypatch, absent, tmp_path))
