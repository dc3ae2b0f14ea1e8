"""Simulated slides as examples: drawn alike every time, each with its own tap, made once and continued after a kill."""

import numpy as np
import pytest

from jaxunshear.config.data import Recorded
from jaxunshear.config.sensor import TACTIP_331, Preprocess
from jaxunshear.data.recorded_frames import UnstoredSet
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.training import simulated_slides

PINS, SIZE = 7, 32
ANGLE = np.arange(PINS)
REST = np.float32(16 + 8 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], -1))


class Stored(UnstoredSet):
    """Eight taps and three slides in every split."""

    def __init__(self):
        generator = np.random.default_rng(0)
        count = 11
        pose, number = np.zeros((count, 6), np.float32), np.arange(count, dtype=np.int32)
        pose[:, 1], pose[:, 2] = generator.uniform(-3, 3, count), generator.uniform(3, 5, count)
        pose[2, 1] = np.nan  # a tap without a label
        self._rows = {
            "image": np.packbits(generator.random((count, SIZE * SIZE)) > 0.5, axis=-1),
            "pins": REST + generator.normal(0, 1, (count, PINS, 2)).astype(np.float32),
            "sure": np.int32(number != 1),
            "slid": np.int32(number >= 8),
            "pose": pose,
            "move": np.zeros((count, 6), np.float32),
            "pose_id": number,
            "number": number,
        }
        frame = {"place_px": REST.tolist(), "shell": [0] + [1] * 6, "spacing_px": 8.0}
        self.metadata = {"frame": frame}

    def rows(self, split):
        return self._rows


@pytest.fixture
def stored():
    folders = {"slide_folder": "s", "tap_folder": "t"}
    settings = Recorded(**folders, pairing="simulated", preprocess=Preprocess(size=SIZE))
    return RecordedSet(settings, Stored())


class Simulator:
    """Every pin moves with the slide, and by the friction; the first contact of a file does not converge."""

    def __init__(self):
        self.asked = []

    def __call__(self, pose, moves, friction):
        self.asked.append(len(pose))
        shift = np.float32(friction[:, None] * moves[:, :2])[:, None]
        return np.tile(shift, (1, PINS, 1)), np.arange(len(pose)) > 0


@pytest.fixture
def simulator():
    return Simulator()


@pytest.fixture
def simulate(stored, simulator, tmp_path):
    """Return a function that makes the simulator of slides anew, as another process would."""

    def make():
        return simulated_slides.make_slide_simulator(stored, TACTIP_331, tmp_path, simulator, 3)

    return make


def test_each_slide_has_its_own_tap(stored, simulate):
    reader = stored.read_pairs((), simulate=simulate())
    # 6 of 8 taps are sure and labelled, in two files whose first contacts do not converge
    assert reader.length("train") == 4 * simulated_slides.SLIDES_PER_MOTION
    pairs = next(reader.split("train", 100))
    taps = stored.read_labelled_taps("train")
    for pins, pose in zip(pairs["canonical_pins"], pairs["pose"], strict=True):
        own = int(np.argmin(np.abs(taps["pins"] - pins).sum((1, 2))))
        np.testing.assert_array_equal(taps["pose"][own], pose)
    assert len(set(pairs["pose_id"].tolist())) == len(pairs["pose"])  # none is paired anew
    assert np.abs(pairs["move"][:, :2]).max() <= simulated_slides.SLIDE_MM
    assert not pairs["move"][:, 2].any()
    assert pairs["sheared"].shape == pairs["canonical"].shape == (16, SIZE, SIZE, 1)
    assert (pairs["sheared"] != pairs["canonical"]).any(axis=(1, 2, 3)).all()
    without = stored.read_pairs((), images=False, simulate=simulate())
    assert "canonical" not in next(without.split("train", 1))


def test_slides_are_simulated_once_and_go_on_after_a_kill(simulate, simulator, tmp_path):
    first = simulate()("train")
    assert simulator.asked == [3, 3, 3, 3]  # two files of training, two of validation
    (file,) = tmp_path.rglob("train/00001.npz")
    file.unlink()
    again = simulate()("train")
    assert simulator.asked[4:] == [3]
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
    assert not np.array_equal(first["move"], simulate()("validation")["move"])
