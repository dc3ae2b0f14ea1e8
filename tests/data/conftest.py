"""Stand in for the simulator: microseconds a contact, and each image shows its contact's number."""

import os
import time
from types import SimpleNamespace

import numpy as np
import pytest

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.sensor import Preprocess, Sensor
from jaxunshear.data.simulation import SimulationEngine

SENSOR = Sensor(name="small", rings=2)
SIZE = 32
PINS_PER_CONTACT = 1e-3  # px by which the pins of each contact differ from those of the one before
PAIRED = PairedData(
    config="tiny",
    stimuli=("disk", "spiral_1"),
    poses=10,
    slides=3,
    taps=2,
    preprocess=Preprocess(size=SIZE),
)
POSE = PoseData(
    config="tiny", stimuli=("disk", "spiral_1"), poses=10, preprocess=Preprocess(size=SIZE)
)


def plan(sensor, names, scenes):
    order = np.argsort(scenes.pose[:, 3], kind="stable")
    return [order[start : start + 16] for start in range(0, len(order), 16)]


def simulate(sensor, names, scenes):
    time.sleep(float(os.environ.get("FAKE_SECONDS", "0")))
    count = len(scenes)
    pins = np.repeat(scenes.pose[:, None, :3], sensor.pins, axis=1).astype(np.float32)
    number = np.arange(count)
    return SimpleNamespace(
        pins=pins,
        residual_mm=np.full(count, 1e-3, np.float32),
        converged=np.ones(count, bool),
        retried=np.zeros(count, bool),
        iterations=number,
        stuck_nodes=number + 1,
        slipping_nodes=number + 2,
        free_nodes=number + 3,
    )


def render(settings, sensor, tips, number, age):
    size = settings.preprocess.size
    generators = [np.random.default_rng([settings.seed, int(index)]) for index in number]
    images = [generator.random((size, size)) < 0.3 for generator in generators]
    pins = np.asarray(tips[..., :2] + size / 2, np.float32)
    pins = pins + PINS_PER_CONTACT * np.reshape(number, (-1, 1, 1))
    return np.stack(images).astype(np.uint8) * np.uint8(255), pins.astype(np.float32)


ENGINE = SimulationEngine(plan, simulate, render)


@pytest.fixture
def engine() -> SimulationEngine:
    return ENGINE


@pytest.fixture
def sensor() -> Sensor:
    return SENSOR


@pytest.fixture
def paired() -> PairedData:
    return PAIRED


@pytest.fixture
def pose() -> PoseData:
    return POSE
