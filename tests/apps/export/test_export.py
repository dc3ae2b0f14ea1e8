"""Models as files for a computer without JAX compute what JAX computes, or are refused."""

import ast
import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.export
import numpy as np
import onnxruntime
import pytest
from PIL import Image

from jaxunshear import load_model
from jaxunshear.apps.export import networks
from jaxunshear.apps.export.export import build_stablehlo
from jaxunshear.apps.export.onnx_file import build_onnx, make_onnx_runner
from jaxunshear.apps.export.onnx_graph import FLOAT, OnnxGraph, preprocess_frames, read_camera
from jaxunshear.apps.export.parts import (
    MAX_DIFFERENCE,
    ExportedModel,
    make_check_inputs,
    measure_difference,
)
from jaxunshear.apps.export.sensor_check import (
    JaxGraph,
    add_image_plausibility,
    make_sensor_check,
)
from jaxunshear.apps.robot.stream import SCHEMA
from jaxunshear.cli import main
from jaxunshear.config import targets
from jaxunshear.config.data import PairedData, PoseData, Ranges
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PinPoseNet, PinUnshear, PoseNet, UnshearNet
from jaxunshear.config.sensor import TACTIP_331, Preprocess
from jaxunshear.config.serialization import RELEASED, to_json
from jaxunshear.data.recordings import read_image
from jaxunshear.files import write_json
from jaxunshear.inference.forward import bind_networks, chain_networks
from jaxunshear.models import pin_networks, posenet, unshearnet
from jaxunshear.models.pin_networks import make_grid
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.perception.sensor_check import FOREIGN_REASON
from jaxunshear.training import checkpoint
from jaxunshear.training.checkpoint import TrainedNetwork
from tests.helpers.models import write_network

ROOT = Path(__file__).resolve().parents[3]
SIZE = 32
NET = UnshearNet(size=SIZE, widths=(4, 6, 8), pose_channels=5, shear_channels=3)
POSENET = PoseNet(size=SIZE, widths=(4, 5, 6, 7, 8), hidden=9)
PINS = {"hidden": 16, "layers": 2, "pose_code": 5, "shear_code": 2}
TARGETS = targets.make_range_targets((), Ranges())
OUTPUTS = targets.count_outputs(TARGETS)
PREPROCESS = Preprocess(size=SIZE)
SENSOR = dataclasses.replace(
    TACTIP_331, name="few", rings=2, pin_spacing_mm=5 * TACTIP_331.pin_spacing_mm
)
REST = np.float32(compute_rest_lattice(SENSOR, PairedData().camera, PREPROCESS).rest)
CHECK = make_sensor_check(REST, SIZE)
EXPERIMENT = Experiment(
    "small",
    "A claim.",
    unshear=NET,
    posenet=POSENET,
    sensor=SENSOR,
    paired=PairedData(preprocess=PREPROCESS),
    pose=PoseData(preprocess=PREPROCESS),
)


def drawn(init):
    """Make variables of the shapes of `init`, as if trained: no two layers are alike."""
    random = np.random.default_rng(1)

    def draw(path, leaf):
        near = {"scale": 1.0, "var": 1.0}.get(path[-1].key, 0.0)
        spread = 1.5 / np.sqrt(np.prod(leaf.shape[:-1])) if len(leaf.shape) > 1 else 0.2
        return np.asarray(near + spread * random.uniform(-1.7, 1.7, leaf.shape), np.float32)

    return jax.tree_util.tree_map_with_path(draw, jax.eval_shape(lambda: init(jax.random.key(0))))


def drawn_of_pins(net, outputs=0):
    variables = drawn(lambda key: pin_networks.init(net, REST, 1.5, key, outputs))
    grid = {"grid": make_grid(REST)} if "grid" in variables["batch_stats"] else {}
    return variables | {"batch_stats": {"rest": REST, "spread": np.float32(1.5)} | grid}


def images(net=NET):
    unshears = TrainedNetwork(net, drawn(lambda key: unshearnet.init(net, key)), ())
    variables = drawn(lambda key: posenet.init(POSENET, OUTPUTS, key))
    reads = TrainedNetwork(POSENET, variables, TARGETS)
    return ExportedModel({"disentangled": unshears, "posenet": reads}, None, CHECK)


def pins(rotated_share=0.0, conv_channels=(), read_by=()):
    net = PinUnshear(**PINS, conv_channels=conv_channels)
    reader = PinPoseNet(**PINS, rotated_share=rotated_share, conv_channels=read_by)
    reads = TrainedNetwork(reader, drawn_of_pins(reader, OUTPUTS), TARGETS)
    unshears = TrainedNetwork(net, drawn_of_pins(net), ())
    return ExportedModel({"disentangled": unshears, "posenet": reads}, REST, CHECK)


def select(parts, **names):
    """Select networks of parts by their new names."""
    return parts._replace(networks={new: parts.networks[old] for new, old in names.items()})


def make_runner(parts, batch=None, camera=None, reader=None):
    """Return a function that runs the ONNX file of these parts."""
    return make_onnx_runner(build_onnx(parts, batch, camera, {}), reader or parts)


CASES = {
    "images": images,
    "entangled": lambda: images(dataclasses.replace(NET, disentangled=False)),
    "no reader": lambda: select(images(), disentangled="disentangled"),
    "reader alone": lambda: select(images(), posenet="posenet"),
    "reader of slides": lambda: select(
        images(), disentangled="disentangled", posenet_sheared="posenet"
    ),
    "pins": pins,
    "pins, turned": lambda: pins(0.5),
    "pins, convolved": lambda: pins(conv_channels=(4, 6, 5)),
    "pins, reader convolved": lambda: pins(read_by=(4, 6)),
}


@pytest.mark.parametrize(
    ("case", "batch"), [*((case, 3) for case in CASES), ("images", None), ("pins", None)]
)
def test_onnxruntime_computes_what_jax_does(case, batch):
    parts = CASES[case]()
    run, given = make_runner(parts, batch), make_check_inputs(parts)
    assert measure_difference(parts, run, given, batch) < 2e-5
    # networks that saw nothing would agree, too
    assert all(np.ptp(pose) > 1e-3 for pose in run(given[:3]).get("pose", {}).values())


def test_another_network_differs():
    parts = pins()
    other = jax.tree.map(np.copy, parts.pose_network.variables)
    other["params"]["Dense_0"]["bias"] += 0.05
    reads = parts.pose_network._replace(variables=other)
    other_parts = parts._replace(networks=parts.networks | {"posenet": reads})
    run = make_runner(other_parts, reader=parts)
    assert measure_difference(parts, run, make_check_inputs(parts), None) > MAX_DIFFERENCE


def test_a_full_circle_has_no_seam():
    """All quadrants and axes, against arctan2."""
    angle = np.deg2rad(np.arange(-180, 181, 15, dtype=np.float64))
    outputs = np.float32((np.stack([np.cos(angle), np.sin(angle)], -1) * 0.7 + 1) / 2)
    graph, circle = OnnxGraph(), (targets.Target("edge_deg", "edge", 1, is_circular=True),)
    graph.add_output("pose", networks.add_pose(graph, circle, "outputs"), ("batch", 1))
    file = graph.build("outputs", ("batch", 2), FLOAT, {}).SerializeToString()
    (pose,) = onnxruntime.InferenceSession(file).run(None, {"outputs": outputs})
    off = pose[:, 0] - np.rad2deg(angle)
    np.testing.assert_allclose((off + 180) % 360 - 180, 0, atol=1e-4)


def test_a_class_is_the_number_of_its_largest_output():
    outputs = np.random.default_rng(0).random((20, 4), np.float32)
    of_three = targets.Target("object_class", targets.OTHERS, 0, classes=3)
    graph, both = OnnxGraph(), (targets.Target("x_mm", "pose", 0), of_three)
    graph.add_output("pose", networks.add_pose(graph, both, "outputs"), ("batch", 2))
    file = graph.build("outputs", ("batch", 4), FLOAT, {}).SerializeToString()
    (pose,) = onnxruntime.InferenceSession(file).run(None, {"outputs": outputs})
    np.testing.assert_array_equal(pose[:, 1], outputs[:, 1:].argmax(axis=1))


def frames_in(folder, kind):
    """Six frames of a camera, dark with light pins in a light surround."""
    random = np.random.default_rng(0)
    rows, columns = np.mgrid[:90, :110]
    folder.mkdir()
    for number in range(6):
        pins = 2.6 * (REST - REST[0]) + random.normal(0, 1, 2) + [62, 46]
        away = np.hypot(columns[..., None] - pins[:, 0], rows[..., None] - pins[:, 1]).min(-1)
        pinned, disc = away < 4, np.hypot(rows - 46, columns - 62) < 44
        grey = np.where(disc, 0.15 + 0.6 * pinned, 0.75) + random.normal(0, 0.02, rows.shape)
        if kind == "binary":
            grey = (disc & pinned).astype(float)
        if kind == "dim":
            grey = 0.2 * grey
        if kind == "colour":
            grey = grey[..., None] * np.array([1, 0.8, 0.5])
        Image.fromarray(np.uint8(np.clip(255 * grey, 0, 255))).save(folder / f"{number}.png")
    return folder


def read_frames(folder):
    return np.stack([read_image(file) for file in sorted(folder.glob("*.png"))])


@pytest.mark.parametrize("kind", ["grey", "dim", "colour", "binary"])
@pytest.mark.parametrize("box", [None, (-4, 20, 80, 104)], ids=["found", "over the border"])
def test_frames_are_prepared_in_the_file(tmp_path, kind, box):
    folder = frames_in(tmp_path / "frames", kind)
    camera = read_camera(folder, PREPROCESS, None if box is None else View(box))
    frames, view = read_frames(folder), View(camera.box)
    expected = np.stack([prepare_frame(camera.preprocess, frame, view) for frame in frames])
    assert 0.05 < np.mean(expected > 0) < 0.8
    run = make_runner(images(), camera=camera)
    np.testing.assert_array_equal(run(frames)["image"], expected)


def test_frames_prepared_otherwise_differ(tmp_path):
    camera, parts = read_camera(frames_in(tmp_path / "frames", "grey"), PREPROCESS, None), images()
    run = make_runner(parts, camera=camera)

    def measure(prepare):
        return measure_difference(parts, run, camera.frames, None, prepare)

    assert measure(lambda each: preprocess_frames(camera, each)) < 2e-5
    assert measure(lambda each: 255 - preprocess_frames(camera, each)) > 0.5


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    folder, parts = tmp_path_factory.mktemp("runs") / "small", images()
    for name, part in parts.networks.items():
        write_network(folder / name, part.net, part.variables, part.targets)
        checkpoint.write_weights(folder / name, part.variables)
    write_json(folder / "experiment.json", to_json(EXPERIMENT))
    return folder


@pytest.fixture(scope="module")
def model(run_dir):
    return load_model(run_dir, force=True)


def export_model(model, out, *options):
    assert main(["export", str(model), "--out", str(out), *map(str, options)]) == 0
    return out


def test_stablehlo_is_read_by_jax_alone(run_dir, model, tmp_path, capsys):
    out = export_model(run_dir, tmp_path / "touch.stablehlo")
    assert "differs from JAX by at most" in capsys.readouterr().out
    exported = jax.export.deserialize(bytearray(out.read_bytes()))
    assert exported.platforms == ("cpu", "cuda") and str(exported.in_avals[0].shape[0]) == "batch"
    seen = make_check_inputs(images())[:2]
    found, expected = exported.call(seen)["pose"], model.pose(seen)["unsheared"]
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, atol=1e-2)


def test_stablehlo_of_one_batch():
    parts = pins()
    exported = jax.export.deserialize(bytearray(build_stablehlo(parts, 3)))
    assert exported.in_avals[0].shape == (3, *REST.shape)
    lines = exported.mlir_module().splitlines()
    products = [line for line in lines if "stablehlo.dot_general" in line]
    assert products and all("HIGHEST" in line for line in products)  # a GPU would round

    def run(given):
        return jax.device_get(exported.call(given))

    assert measure_difference(parts, run, make_check_inputs(parts), 3) < 2e-5


def test_a_file_says_what_it_is_and_reads_what_the_model_reads(run_dir, model, tmp_path):
    out = export_model(run_dir, tmp_path / "new" / "touch.onnx", "--batch", 2)
    session = onnxruntime.InferenceSession(out)
    known = session.get_modelmeta().custom_metadata_map
    assert (known["size_px"], known["pose_of"]) == ("32", "unsheared")
    assert "simulated" in known["learnt"] and known["jaxunshear"]
    names, units = known["names"].split(","), known["units"].split(",")
    assert units == [name.rpartition("_")[2] for name in names] and set(units) == {"mm", "deg"}
    assert session.get_inputs()[0].shape == [2, 32, 32]
    seen = make_check_inputs(images())[:2]
    after, sure, pose = session.run(["unsheared", "confidence", "pose"], {"image": seen})
    expected = model.pose(seen)["unsheared"]
    assert expected.keys() == set(names)
    np.testing.assert_allclose(pose.T, [expected[name] for name in names], atol=1e-2)
    np.testing.assert_allclose(after, model.unshear(seen), atol=1e-4)
    crisp = (after**2).sum((1, 2)) / after.sum((1, 2))
    plausible = add_image_plausibility(JaxGraph(), CHECK, np.float32(seen[:, None] / 255))
    np.testing.assert_allclose(sure, crisp * plausible, rtol=1e-3)


def test_skin_takes_pins(tmp_path):
    session = onnxruntime.InferenceSession(export_model("skin", tmp_path / "skin.onnx"))
    known = session.get_modelmeta().custom_metadata_map
    assert session.get_inputs()[0].shape == ["batch", 331, 2] and "331" in known["input"]
    pins = np.random.default_rng(0).normal(json.loads(known["rest_px"]), 1, (3, 331, 2))
    pins = pins.astype(np.float32)
    pins[0, :9] = np.nan
    skin = load_model("skin")
    loaded = {name: skin.load_network(name) for name in ("disentangled", "posenet")}
    weights = {name: network.variables for name, network in loaded.items()}
    run = jax.jit(chain_networks(bind_networks(loaded, weights), with_sheared_poses=False))
    after, poses = run(pins)
    found = session.run(["unsheared", "pose"], {"pins": pins})
    np.testing.assert_allclose(found[0], after, atol=1e-3)
    expected = [poses["unsheared"][target.name] for target in loaded["posenet"].targets]
    np.testing.assert_allclose(found[1].T, expected, atol=1e-3)


def test_what_differs_is_refused_and_leaves_nothing(run_dir, tmp_path, capsys):
    out = tmp_path / "touch.onnx"
    out.write_bytes(b"an earlier one")
    variables = jax.tree.map(np.copy, images().unshear_network.variables)
    variables["params"]["pose"]["kernel"][0] = np.nan
    shutil.copytree(run_dir, tmp_path / "spoilt")
    checkpoint.write_weights(tmp_path / "spoilt" / "disentangled", variables)
    assert main(["export", str(tmp_path / "spoilt"), "--out", str(out)]) == 2
    assert "would differ from JAX by nan" in capsys.readouterr().err
    assert out.read_bytes() == b"an earlier one" and not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("standard --out a.pb", "--out a.pb: name a file that ends in .onnx or .stablehlo"),
        ("standard --out a.onnx --batch few", "--batch few: use a number, or any"),
        ("standard --out a.onnx --batch 0", "--batch 0: use 1 to 4096"),
        ("nothing --out a.onnx", "nothing holds no experiment.json"),
        ("standard --out a.stablehlo --preprocess x", "in files that end in .onnx alone"),
        ("standard --out a.onnx --preprocess x", "x does not exist"),
        (
            "skin --out a.onnx --preprocess x",
            "skin reads pins, which are found outside of the file",
        ),
        (f"standard --out {RELEASED / 'standard' / 'a.onnx'}", "which is a run or weights"),
    ],
)
def test_what_cannot_be_exported_is_refused(words, complaint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", *words.split()]) == 2
    assert complaint in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_missing_extra_is_named(tmp_path, absent, capsys):
    absent("onnxruntime")
    assert main(["export", "standard", "--out", str(tmp_path / "a.onnx")]) == 2
    assert "'.[onnx]'" in capsys.readouterr().err


def test_a_robot_s_program_in_python(run_dir, tmp_path):
    program = ROOT / "examples" / "robot.py"
    nodes = ast.walk(ast.parse(program.read_text()))
    imported = {name.name for node in nodes for name in getattr(node, "names", [])}
    assert imported == {"importlib", "json", "sys", "time", "Path", "numpy", "onnxruntime"}
    folder = frames_in(tmp_path / "frames", "colour")
    out = export_model(run_dir, tmp_path / "touch.onnx", "--preprocess", folder)
    (tmp_path / "touch_pins.py").unlink()  # which needs more; test_camera_images.py has both
    frames = read_frames(folder)
    frames = np.concatenate([frames, np.zeros_like(frames[:1])])
    np.save(tmp_path / "frames.npy", frames)
    command = [sys.executable, program, out, tmp_path / "frames.npy"]
    ran = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    lines = [json.loads(line) for line in ran.stdout.splitlines()]
    names = [target.name for target in TARGETS]
    outputs = onnxruntime.InferenceSession(out).run(["pose", "confidence"], {"frame": frames})
    *shown, last = lines
    place = {"schema": SCHEMA, "frame": 6, "name": f"{tmp_path / 'frames.npy'} 6", "time_s": None}
    for line, pose, confidence in zip(shown, *outputs, strict=False):
        assert list(line) == [*place, "confidence", "pose", "ms"] and list(line["pose"]) == names
        np.testing.assert_allclose(list(line["pose"].values()), pose, atol=1e-3)
        assert line["confidence"] == pytest.approx(confidence, abs=1e-4) and confidence > 0
    assert last.pop("ms") > 0
    assert last == place | {"confidence": 0.0, "error": FOREIGN_REASON}


def test_a_robot_s_program_in_c(run_dir, tmp_path):
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    command = [compiler, "-std=c++17", "-Wall", "-Wextra", "-Werror", "-x", "c++"]
    headers = tmp_path / "headers.cpp"
    headers.write_text("#include <onnxruntime_cxx_api.h>\n")
    if subprocess.run([*command, "-fsyntax-only", headers], capture_output=True).returncode:
        pytest.skip("CPLUS_INCLUDE_PATH names no folder of ONNX Runtime's C++ headers")
    # Python's own
    (library,) = (Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*")
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (tmp_path / name).symlink_to(library)
    robot = tmp_path / "robot"
    linked = ["-L", tmp_path, "-lonnxruntime", f"-Wl,-rpath,{tmp_path}", "-o", robot]
    subprocess.run([*command, ROOT / "examples" / "robot.cpp", *linked], check=True)
    out = export_model(run_dir, tmp_path / "touch.onnx", "--batch", 1)
    shown = make_check_inputs(images())[-3:]
    options = {"input": shown.tobytes(), "capture_output": True, "check": True, "timeout": 60}
    ran = subprocess.run([robot, out], **options)
    words = [line.split() for line in ran.stdout.decode().splitlines()]
    session = onnxruntime.InferenceSession(out)
    outputs = [session.run(["pose", "confidence"], {"image": image[None]}) for image in shown]
    expected = [[*pose[0], *confidence] for pose, confidence in outputs]
    names = [*(target.name for target in TARGETS), "confidence"]
    assert [line[::2] for line in words] == 3 * [names]
    np.testing.assert_allclose(np.array([line[1::2] for line in words], float), expected, atol=1e-3)
