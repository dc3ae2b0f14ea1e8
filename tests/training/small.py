"""A training small enough for tests, of random dots: `python small.py FOLDER [STEPS_BEFORE_SLOW]` runs it.

Kept apart from the tests because a test kills it.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.targets import make_range_targets
from jaxunshear.config.training import Training, drop_pair_losses

SIZE = 16
NET = UnshearNet(size=SIZE, widths=(4, 6), pose_channels=4, shear_channels=3)
POSENET = PoseNet(size=SIZE, widths=(4, 4, 4, 4, 4), hidden=8)
TRAINING = Training(epochs=3, batch=4, crops=5, crop_px=5, validate_every=4, l1=1e-5, l2=1e-5)
POSENET_TRAINING = drop_pair_losses(TRAINING, pose=1.0)
IMAGES = 16  # an epoch: 4 steps, 12 in all
TARGETS = make_range_targets((), Ranges())


def dots(key: int, images: int, size: int = SIZE) -> np.ndarray:
    """Random dots, uint8 {0, 255} (images, size, size, 1)."""
    return (np.random.default_rng(key).random((images, size, size, 1)) < 0.2).astype(np.uint8) * 255


def pair(key: int, images: int, size: int = SIZE) -> dict[str, np.ndarray]:
    canonical = dots(key, images, size)
    return {"canonical": canonical, "sheared": np.roll(canonical, 2, 2)}


def pose(key: int, images: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(key)
    poses = rng.uniform(-1, 1, (images, 4)).astype(np.float32) * np.float32([5, 5, 45, 6])
    return {"image": dots(key, images), "pose": poses, "edge": poses[:, :2] * np.float32([1, 30])}


def endless(make, start: int, pause: float = 0.0) -> Iterator[dict[str, np.ndarray]]:
    step = start
    while True:
        time.sleep(pause)
        yield make(step, TRAINING.batch)
        step += 1


def train(folder: Path, pause: float = 0.0):
    from jaxunshear.training import trainer
    from jaxunshear.training.tasks import make_unshear_task

    def validation():
        return iter([pair(1000, 4), pair(1001, 3)])

    task = make_unshear_task(NET, TRAINING)
    data = trainer.TrainingData(lambda start: endless(pair, start, pause), validation, IMAGES)
    return trainer.train(task, TRAINING, data, 0, folder)


if __name__ == "__main__":
    train(Path(sys.argv[1]), pause=float(sys.argv[2]))
