"""Frames of a simulated camera, and robots' programs that have neither JAX nor this package."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy import ndimage

from jaxunshear.angles import rotation_2d
from jaxunshear.data.simulation import render_images
from jaxunshear.simulator.pin_layout import compute_pin_tips

ROBOT = Path(__file__).resolve().parents[2] / "examples" / "robot.py"
CONTACTS = 24
PROGRAM = """
import runpy
import sys
from pathlib import Path


class Absent:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in ("jax", "jaxlib", "jaxtyping", "flax", "jaxunshear"):
            raise ImportError(name)


sys.meta_path.insert(0, Absent())
import numpy as np
from touch_pins import CAMERA

frames = np.load("frames.npy")
readings = [CAMERA.read(frame) for frame in frames]
learnt = CAMERA.learn_rest_positions(frames[-2:-1]).read(frames[0])
inputs, pins, touch, reasons, _ = zip(*readings)
found = dict(inputs=np.concatenate(inputs), pins=np.stack(pins), reasons=reasons)
np.savez("read.npz", **found, learnt=list(learnt.touch.values()))
sys.argv[1:] = ["touch.onnx", "frames.npy"]
sys.path.insert(0, "")
runpy.run_path(ROBOT, run_name="__main__")
"""


def make_frames(model):
    """Render frames of a camera: CONTACTS of them touched, then one untouched and one of noise."""
    random, sensor = np.random.default_rng(0), model.sensor
    tips = np.stack([compute_pin_tips(sensor)] * (CONTACTS + 1))
    for row in range(0, CONTACTS, 6):  # six copies, turned: the mean of all is round
        middle, drag = random.uniform(-3, 3, (2, 2)) * [[1], [0.2]]
        for number in range(6):
            turn = rotation_2d(np.radians(60 * number))
            place = tips[row + number]  # a view
            offset = place[:, :2] - turn @ middle
            share = np.exp(-np.square(offset).sum(-1) / (2 * 5.0**2))[:, None]
            place[:, :2] += share * (0.15 * offset + turn @ drag)
    paired = model.experiment.paired
    numbers, ages = np.arange(len(tips)), np.zeros(len(tips))
    images, _ = render_images(paired, sensor, tips, numbers, ages, len(tips))
    frames = np.kron(images, np.ones((1, 3, 3)))
    grey = 30 + 0.6 * ndimage.gaussian_filter(frames, (0, 1.5, 1.5))
    grey = np.concatenate([grey, random.uniform(0, 255, grey[:1].shape)])
    return np.uint8(np.clip(grey + random.normal(0, 2, grey.shape), 0, 255))


def run_robot(folder):
    """Run PROGRAM in a folder with touch.onnx, its module and frames.npy; return stdout."""
    command = [sys.executable, "-c", PROGRAM.replace("ROBOT", repr(str(ROBOT)))]
    ran = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, env={"PATH": ""}
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout
