"""Open the examples of a network, with what trained networks and the simulator add to them.

>>> examples = open_examples(experiment, "disentangled", data_dir, run_dir)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.networks import POSENET_SHEARED, RENDERER
from jaxunshear.config.targets import RECORDED_FIELDS
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.recorded_set import PoseEstimator, RecordedSet, SlideSimulator, TapRenderer
from jaxunshear.data.sources import Examples, open_source
from jaxunshear.errors import UserError
from jaxunshear.models import pin_networks, posenet
from jaxunshear.training.checkpoint import SUMMARY
from jaxunshear.training.trained_network import TrainedNetwork, load_network

POSES_AT_ONCE = 1024
IMAGES_AT_ONCE = 128
FRAME = "frame.json"  # in a run's folder: what all frames of its sensor have in common


def open_examples(experiment: Experiment, network: str, data_dir: Path, run_dir: Path) -> Examples:
    """Open the examples of `network`.

    Raises UserError if the data set, or the renderer that its pairs take, is missing or damaged.
    """
    config, inputs = (
        resolve_network(experiment, network),
        HelperLoader(experiment, data_dir, run_dir),
    )
    return open_source(experiment).open_examples(config, data_dir, inputs)


@dataclass(frozen=True)
class HelperLoader:
    """What a run's trained networks, and the simulator, add to examples; see `Helpers`."""

    experiment: Experiment
    data_dir: Path
    run_dir: Path

    def load_renderer(self) -> TapRenderer:
        """Load the renderer as a function of poses (N, 6). Raises UserError."""
        net, variables, targets = _load_network(self.run_dir / RENDERER, "pairs that are rendered")
        run = jax.jit(partial(pin_networks.render_pins, net, variables))

        def render_part(poses: np.ndarray) -> ArrayLike:
            return run(posenet.scale_poses({"pose": poses}, targets))

        def render(poses: np.ndarray) -> np.ndarray:
            return _run_in_parts(render_part, poses, POSES_AT_ONCE)

        return render

    def load_estimator(self) -> PoseEstimator:
        """Load the PoseNet of slides as a function of images and pins. Raises UserError.

        It returns poses (N, 6), 0 in columns that are not among its targets.
        """
        net, variables, targets = _load_network(
            self.run_dir / POSENET_SHEARED, "slides without labels that are read"
        )
        over_pins = self.experiment.unshear.input == "pins"
        predict = partial((pin_networks if over_pins else posenet).predict, net, variables)
        run = jax.jit(lambda inputs: posenet.unscale_outputs(predict(inputs), targets))

        def estimate_part(inputs: np.ndarray) -> np.ndarray:
            if not over_pins:
                inputs = inputs[..., None].astype(np.float32) / 255
            poses = run(inputs)
            zero = np.zeros(len(inputs), np.float32)
            columns = [np.asarray(poses.get(name, zero)) for name in RECORDED_FIELDS]
            return np.stack(columns, axis=-1)

        def estimate(images: np.ndarray | None, pins: np.ndarray) -> np.ndarray:
            return _run_in_parts(estimate_part, pins if images is None else images, IMAGES_AT_ONCE)

        return estimate

    def load_simulator(self, stored: RecordedSet) -> SlideSimulator:
        """Load simulated slides to the taps of a set, or simulate them. Raises UserError."""
        from jaxunshear.training.simulated_slides import make_slide_simulator

        return make_slide_simulator(stored, self.experiment.sensor, self.data_dir)


def read_all_training(reader: Reader, *fields: str) -> Batch:
    """Read all training examples, in their order."""
    return reader.take("train", np.arange(reader.length("train")), fields)


def measure_pin_spread(reader: Reader, field: str, rest: np.ndarray) -> float:
    """Measure how far the pins of training examples have moved, root mean square in px."""
    pins = read_all_training(reader, field)[field]
    return float(np.sqrt(np.nanmean(np.square(pins - rest))))


def _load_network(folder: Path, what: str) -> TrainedNetwork:
    """Load a trained network that `what` needs. Raises UserError."""
    if not (folder / SUMMARY).exists():
        raise UserError(f"{folder} is missing, and {what} need it: train {folder.name} first")
    return load_network(folder)


def _run_in_parts(
    function: Callable[[np.ndarray], ArrayLike], values: np.ndarray, count: int
) -> np.ndarray:
    """Run `function` on `values` (N, ...), `count` at a time: one shape to compile."""
    results = []
    for start in range(0, max(1, len(values)), count):
        part = values[start : start + count]
        filled = np.zeros((count, *values.shape[1:]), values.dtype)
        filled[: len(part)] = part
        results.append(np.asarray(function(filled))[: len(part)])
    return np.concatenate(results)
