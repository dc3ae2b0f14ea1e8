"""A training of random dots, small enough for tests: `python small.py FOLDER PAUSE_S` can be killed."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.targets import make_range_targets
from jaxunshear.config.training import Training, drop_pair_losses
from jaxunshear.training import trainer
from jaxunshear.training.tasks import make_unshear_task

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


def validate() -> Iterator[dict[str, np.ndarray]]:
    return iter([pair(1000, 4), pair(1001, 3)])


def train(
    folder: Path,
    batches=lambda start: endless(pair, start),
    validation=validate,
    net=NET,
    training=TRAINING,
    provenance=trainer.Provenance(),
):
    data = trainer.TrainingData(batches, validation, IMAGES)
    return trainer.train(make_unshear_task(net, training), training, data, 0, folder, provenance)


if __name__ == "__main__":
    train(Path(sys.argv[1]), lambda start: endless(pair, start, float(sys.argv[2])))
