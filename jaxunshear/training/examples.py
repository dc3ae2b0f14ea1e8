"""Open the examples of a network, with what trained networks and the simulator add to them.

>>> examples = open_examples(experiment, "disentangled", data_dir, run_dir)
>>> few = select_few_pairs(examples, share=0.1, seed=0)  # slides of a tenth of the poses
>>> batches = few.reader.train_batches(64, 0, 0.0, fields)
>>> batches = add_taps(batches, taps, 32, seed=0)  # {"tap_pins"} (32, P, 2) px
>>> # two slides to one pose: {"one_pins", "another_pins"} (32, P, 2) px
>>> batches = add_same_pose_slides(batches, examples, 32, seed=0)
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import NetworkConfig, resolve_network
from jaxunshear.config.networks import POSENET_SHEARED, RENDERER, TEACHER
from jaxunshear.config.splits import hash_text
from jaxunshear.config.targets import RECORDED_FIELDS
from jaxunshear.data.reader import Batch, Reader, group_by_pose
from jaxunshear.data.recorded_set import PoseEstimator, RecordedSet, SlideSimulator, TapRenderer
from jaxunshear.data.sources import Examples, Teacher, open_source
from jaxunshear.data.stored_sets import SetReader, open_set
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.modality import IMAGES, PINS
from jaxunshear.models.registry import get_net_modality, predict, run_in_batches, scale_inputs
from jaxunshear.training.checkpoint import MODEL, TrainedNetwork, load_network
from jaxunshear.training.losses import ANOTHER, ONE, TAPS
from jaxunshear.training.provenance import check_origin

POSES_AT_ONCE = 1024
IMAGES_AT_ONCE = 128
VALIDATION_BATCH = 64
FRAME = "frame.json"  # in a run's folder: what all frames of its sensor have in common
NO_SHIFT = np.zeros(2)
Batches = Callable[[int], Iterator[Batch]]


def open_examples(experiment: Experiment, network: str, data_dir: Path, run_dir: Path) -> Examples:
    """Open the examples of `network`.

    Raises UserError if the data set, or the renderer that its pairs take, is missing or damaged.
    """
    config = resolve_network(experiment, network)
    helpers = HelperLoader(experiment, data_dir, run_dir)
    return open_source(experiment).open_examples(config, data_dir, helpers)


@dataclass(frozen=True)
class HelperLoader:
    """What a run's trained networks, and the simulator, add to examples; see `Helpers`."""

    experiment: Experiment
    data_dir: Path
    run_dir: Path

    def select_part(self, part: Experiment) -> "HelperLoader":
        """Return the helpers of a part of the experiment, whose run is beside this one."""
        return replace(self, experiment=part, run_dir=self.run_dir.parent / part.name)

    def load_renderer(self) -> TapRenderer:
        """Load the renderer as a function of poses (N, 6). Raises UserError."""
        net, variables, targets = load_helper(self.run_dir / RENDERER, "pairs that are rendered")
        run = jax.jit(partial(pin_networks.render_pins, net, variables))

        def render_part(poses: np.ndarray) -> ArrayLike:
            return run(posenet.scale_poses({"pose": poses}, targets))

        def render(poses: np.ndarray) -> np.ndarray:
            return run_in_batches(render_part, poses, POSES_AT_ONCE)

        return render

    def load_teacher(self, shift: np.ndarray = NO_SHIFT) -> Teacher:
        """Load the PoseNet that teaches, for pins that are `shift` px from its own. Raises."""
        net, variables, _ = load_helper(self.run_dir / TEACHER, "other networks")
        check_origin(self.experiment, TEACHER, self.run_dir)
        if get_net_modality(net) is PINS:
            variables = pin_networks.move_frame(variables, -shift)
        return partial(predict, net, variables)

    def load_estimator(self) -> PoseEstimator:
        """Load the PoseNet of slides as a function of images and pins. Raises UserError.

        It returns poses (N, 6), 0 in columns that are not among its targets.
        """
        net, variables, targets = load_helper(
            self.run_dir / POSENET_SHEARED, "slides without labels"
        )

        @jax.jit
        def run(inputs: jax.Array) -> dict[str, jax.Array]:
            return posenet.unscale_outputs(predict(net, variables, inputs), targets)

        def estimate_part(inputs: np.ndarray) -> np.ndarray:
            poses = run(scale_inputs(inputs))
            zero = np.zeros(len(inputs), np.float32)
            columns = [np.asarray(poses.get(name, zero)) for name in RECORDED_FIELDS]
            return np.stack(columns, axis=-1)

        def estimate(images: np.ndarray | None, pins: np.ndarray) -> np.ndarray:
            inputs = pins if images is None else images
            return run_in_batches(estimate_part, inputs, IMAGES_AT_ONCE)

        return estimate

    def load_simulator(self, stored: RecordedSet) -> SlideSimulator:
        """Load simulated slides to the taps of a set, or simulate them. Raises UserError."""
        from jaxunshear.training.simulated_slides import make_slide_simulator

        return make_slide_simulator(stored, self.experiment.sensor, self.data_dir)


def load_helper(folder: Path, learners: str) -> TrainedNetwork:
    """Load a network that others learn from, named by `learners`. Raises UserError."""
    if not (folder / MODEL).exists():
        raise UserError(f"{folder} is missing, and {learners} need it: train {folder.name} first")
    return load_network(folder)


def read_all_training(reader: Reader, *fields: str) -> Batch:
    """Read all training examples, in their order."""
    return reader.take("train", np.arange(reader.length("train")), fields)


def measure_pin_spread(reader: Reader, field: str, rest: np.ndarray) -> float:
    """Measure how far the pins of training examples have moved, root mean square in px."""
    pins = read_all_training(reader, field)[field]
    return float(np.sqrt(np.nanmean(np.square(pins - rest))))


def select_few_pairs(examples: Examples, share: float, seed: int) -> Examples:
    """Select the training and validation slides of a `share` of the poses, at least one.

    `examples` are simulated. An epoch stays as long as it is with all pairs.
    """
    stored = _get_set_reader(examples)

    def load(split: str) -> Batch:
        rows = stored.rows(split)
        if split == "test":
            return dict(rows)
        selected = choose_poses(rows["stimulus"], rows["pose_id"], share, seed)
        return {name: value[selected] for name, value in rows.items()}

    return examples._replace(reader=Reader(load, examples.pins.size))


def choose_poses(stimulus: np.ndarray, pose_id: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Return whether the pose of each row is chosen, (N,).

    Smaller shares lie within larger ones of the same seed.
    """
    poses, row = np.unique(np.stack([stimulus, pose_id], axis=1), axis=0, return_inverse=True)
    hashes = [hash_text(f"pair {seed} {s} {p}") for s, p in poses.tolist()]
    order = sorted(range(len(poses)), key=hashes.__getitem__)
    is_chosen = np.zeros(len(poses), bool)
    is_chosen[order[: max(1, round(share * len(poses)))]] = True
    return is_chosen[row.reshape(-1)]


def add_single_contacts(
    batches: Batches, config: NetworkConfig, examples: Examples, data_dir: Path
) -> Batches:
    """Add the taps and slides without partners that the losses of a network take."""
    count = max(1, config.training.batch // 2)  # in a step, in addition to the pairs
    if config.taps:
        taps = open_set(config.taps, data_dir, config.sensor)
        batches = add_taps(batches, taps, count, config.seed)
    if "consistency" in config.training.losses:
        batches = add_same_pose_slides(batches, examples, count, config.seed)
    return batches


def add_taps(batches: Batches, taps: Reader, count: int, seed: int) -> Batches:
    """Add the pins of `count` taps to each batch, drawn by seed and step."""
    tap_batches = taps.train_batches(count, seed, 0.0, ("pins",))

    def start_batches(start: int = 0) -> Iterator[Batch]:
        for batch, tap_batch in zip(batches(start), tap_batches(start), strict=True):
            yield batch | {TAPS: tap_batch["pins"]}

    return start_batches


def add_same_pose_slides(batches: Batches, examples: Examples, count: int, seed: int) -> Batches:
    """Add `count` pairs of training slides to one pose to each batch, drawn by seed and step.

    A slide that is the only one to its pose is paired with itself.
    """

    def start_batches(start: int = 0) -> Iterator[Batch]:
        rows = _get_set_reader(examples).rows("train")
        pins, groups = rows["sheared_pins"], group_by_pose(rows["stimulus"], rows["pose_id"])
        for step, batch in enumerate(batches(start), start):
            generator = np.random.default_rng((seed, step))
            one = generator.integers(len(pins), size=count)
            another = groups.sample_other(one, generator)
            yield batch | {ONE: pins[one], ANOTHER: pins[another]}

    return start_batches


def _get_set_reader(examples: Examples) -> SetReader:
    assert isinstance(examples.reader, SetReader)  # simulated
    return examples.reader


def rename_inputs(batch: Json) -> Json:
    """Rename the slides of a batch without taps as the inputs of a PoseNet."""
    names = {each.sheared: each.single for each in (IMAGES, PINS) if each.canonical not in batch}
    return {names.get(name, name): values for name, values in batch.items()}


def take_first(
    split: Callable[..., Iterator[Batch]], count: int, fields: tuple[str, ...]
) -> Callable[[], Iterator[Batch]]:
    """Make the function that reads the first `count` validation examples, in batches."""

    def start_batches() -> Iterator[Batch]:
        taken = 0
        for batch in split("validation", VALIDATION_BATCH, fields):
            batch = {name: values[: count - taken] for name, values in batch.items()}
            taken += len(batch[fields[0]])
            yield rename_inputs(batch)
            if taken >= count:
                return

    return start_batches
