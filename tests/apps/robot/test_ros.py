"""The examples for ROS 2, against stubs of what they import of ROS."""

import importlib
import json
import math
import sqlite3
import struct
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
TOPIC, SHAPE = "/tactip/image_raw", (4, 6)
REASON = "not this sensor"


@pytest.fixture
def model(tmp_path):
    """A file like an exported one: edge_mm is the frame's mean, edge_deg ten times that.

    It is not sure of black frames.
    """
    given = helper.make_tensor_value_info("frame", TensorProto.UINT8, [None, *SHAPE])
    pose = helper.make_tensor_value_info("pose", TensorProto.FLOAT, [None, 2])
    confidence = helper.make_tensor_value_info("confidence", TensorProto.FLOAT, [None])
    sure = helper.make_tensor_value_info("sure", TensorProto.BOOL, [None])
    constants = [
        helper.make_tensor("weights", TensorProto.FLOAT, [1, 2], [1.0, 10.0]),
        helper.make_tensor("column", TensorProto.INT64, [2], [-1, 1]),
        helper.make_tensor("black", TensorProto.FLOAT, [], [0.0]),
        helper.make_tensor("none", TensorProto.FLOAT, [], [math.nan]),
    ]
    nodes = [
        helper.make_node("Cast", ["frame"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["float"], ["mean"], axes=[1, 2], keepdims=0),
        helper.make_node("Reshape", ["mean", "column"], ["rows"]),
        helper.make_node("MatMul", ["rows", "weights"], ["poses"]),
        helper.make_node("Greater", ["mean", "black"], ["sure"]),
        helper.make_node("Cast", ["sure"], ["confidence"], to=TensorProto.FLOAT),
        helper.make_node("Greater", ["rows", "black"], ["sure_rows"]),
        helper.make_node("Where", ["sure_rows", "poses", "none"], ["pose"]),
    ]
    graph = helper.make_graph(nodes, "touch", [given], [pose, confidence, sure], constants)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(made, {"names": "edge_mm,edge_deg", "not_sure": REASON})
    onnx.save(made, tmp_path / "touch.onnx")
    return tmp_path / "touch.onnx"


@pytest.fixture
def ros(monkeypatch):
    """Import an example with stubs of rclpy and sensor_msgs beside it."""
    sent, logged = [], []

    class Node:
        def __init__(self, name):
            self.name = name

        def declare_parameter(self, name, value):
            return SimpleNamespace(value=parameters.get(name, value))

        def create_publisher(self, kind, topic, depth):
            return SimpleNamespace(publish=lambda message: sent.append((topic, message)))

        def create_subscription(self, kind, topic, answer, quality):
            self.subscribed = kind, topic, quality.depth

        def get_logger(self):
            return SimpleNamespace(warning=lambda text, **limits: logged.append(text))

        def destroy_node(self):
            sent.append("destroyed")

    def make_joint_state(header):
        return SimpleNamespace(header=header, name=[], position=[])

    parameters = {}
    stubs = {
        "rclpy": {
            "init": lambda: None,
            "spin": lambda node: None,
            "try_shutdown": lambda: None,
        },
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {
            "QoSProfile": SimpleNamespace,
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT=2),
        },
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": object, "JointState": make_joint_state},
    }
    for name, content in stubs.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    for name in ("robot", "ros_messages", "ros2_node"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    load = importlib.import_module
    return SimpleNamespace(parameters=parameters, sent=sent, logged=logged, load=load)


def make_image(pixels, encoding, padding=3):
    """An Image whose rows are longer than its pixels."""
    height, width = pixels.shape[:2]
    rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, padding)))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=7, nanosec=500_000_000)),
        height=height,
        width=width,
        encoding=encoding,
        step=rows.shape[1],
        data=rows.tobytes(),
    )


def encode(image, order):
    """Encode an Image as CDR, byte by byte as the standard has it."""
    out = b""

    def put(kind, value):
        nonlocal out
        out += b"\0" * (-len(out) % struct.calcsize(kind)) + struct.pack(order + kind, value)

    put("i", image.header.stamp.sec)
    put("I", image.header.stamp.nanosec)
    for text in ("camera", None):
        if text is None:
            put("I", image.height)
            put("I", image.width)
            text = image.encoding
        put("I", len(text) + 1)
        out += text.encode() + b"\0"
    out += b"\0"
    put("I", image.step)
    put("I", len(image.data))
    return bytes([0, order == "<", 0, 0]) + out + image.data


def test_the_node_publishes_poses_in_si_with_the_images_time(ros, model):
    ros.parameters["model"] = str(model)
    node = ros.load("ros2_node").TouchNode()
    assert node.subscribed[1:] == ("image", 1)
    image = make_image(np.full(SHAPE, 18, np.uint8), "mono8")
    node.answer(image)
    ((topic, message),) = ros.sent
    assert topic == "pose" and message.header is image.header
    assert message.name == ["edge", "edge"]
    assert message.position == pytest.approx([0.018, math.pi])
    assert not ros.logged


def test_the_node_publishes_no_pose_of_another_sensor(ros, model):
    ros.parameters["model"] = str(model)
    node = ros.load("ros2_node").TouchNode()
    node.answer(make_image(np.zeros(SHAPE, np.uint8), "mono8"))
    assert not ros.sent and ros.logged == [REASON]


def test_the_node_runs_and_is_put_away(ros, model):
    ros.parameters["model"] = str(model)
    ros.load("ros2_node").main()
    assert ros.sent == ["destroyed"]


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "bgr8", "bgra8"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_images_are_decoded_as_they_were_written(ros, encoding, order):
    messages = ros.load("ros_messages")
    colours = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), np.uint8)
    pixels = {
        "mono8": colours[..., 0],
        "rgb8": colours,
        "bgr8": colours[..., ::-1],
        "bgra8": np.dstack([colours[..., ::-1], colours[..., :1]]),
    }[encoding]
    frame = messages.decode_image(encode(make_image(pixels, encoding), order))
    assert frame.time_s == 7.5
    np.testing.assert_array_equal(frame.pixels, colours[..., 0] if encoding == "mono8" else colours)


def test_other_encodings_are_refused(ros):
    messages = ros.load("ros_messages")
    with pytest.raises(SystemExit, match="16UC1"):
        messages.to_pixels("16UC1", SHAPE, 12, bytes(48))


def write_bag(folder, values):
    folder.mkdir()
    with sqlite3.connect(folder / "touch_0.db3") as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT)")
        database.execute("CREATE TABLE messages (topic_id INTEGER, timestamp INTEGER, data BLOB)")
        topics = [(1, "/joint_states", "sensor_msgs/msg/JointState")]
        topics += [(2, TOPIC, "sensor_msgs/msg/Image")]
        database.executemany("INSERT INTO topics VALUES (?, ?, ?)", topics)
        rows = [(1, 0, b"other")]
        for time, value in enumerate(values):
            image = make_image(np.full(SHAPE, value, np.uint8), "mono8")
            rows.append((2, time, encode(image, "<")))
        database.executemany("INSERT INTO messages VALUES (?, ?, ?)", reversed(rows))
    return folder


def test_a_bag_is_read_without_ros(model, tmp_path):
    bag, program = write_bag(tmp_path / "bag", (3, 5, 0)), EXAMPLES / "read_bag.py"

    def run(*words):
        words = [sys.executable, program, *words]
        return subprocess.run(words, capture_output=True, text=True)

    done = run(model, bag, TOPIC)
    assert done.returncode == 0, done.stderr
    first, second, black = map(json.loads, done.stdout.splitlines())
    pose = {"edge_mm": 3, "edge_deg": 30}
    assert first == {"frame": 0, "time_s": 7.5, "confidence": 1, "pose": pose}
    assert second["pose"]["edge_mm"] == 5
    assert black == {"frame": 2, "time_s": 7.5, "confidence": 0, "error": REASON}
    assert run("--save", tmp_path / "frames.npy", bag, TOPIC).returncode == 0
    np.testing.assert_array_equal(np.load(tmp_path / "frames.npy")[:, 0, 0], [3, 5, 0])
    done = run(model, bag, "/camera")
    assert done.returncode == 1 and TOPIC in done.stderr and "Traceback" not in done.stderr
    done = run(model, tmp_path, TOPIC)
    assert done.returncode == 1 and "ros2 bag convert" in done.stderr
