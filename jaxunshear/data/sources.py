"""Data sources: where the contacts come from that networks learn from and are tested on.

>>> source = open_source(experiment)
>>> source.list_sets()  # to be made before anything is trained
>>> examples = source.open_examples(config, data_dir, helpers)
>>> examples.reader.train_batches(batch=8, seed=0, shift=0.0, fields=("canonical", "sheared"))

What differs between simulated contacts, recorded ones and others is in their classes. A further one
is a class with `register_source`, see docs/extending.md. Loads JAX late.
"""

import pkgutil
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, TypeVar, cast

import numpy as np

from jaxunshear.config.configs import compute_fingerprint, describe_set
from jaxunshear.config.data import DataSettings, PairedData, PoseData, SourceSettings
from jaxunshear.config.experiment import Experiment, list_further_tests
from jaxunshear.config.network_config import NetworkConfig, takes_taps
from jaxunshear.config.targets import (
    SIMULATED_FIELDS,
    Targets,
    make_label_targets,
    make_move_targets,
    make_range_targets,
    make_slide_targets,
)
from jaxunshear.config.types import claim_name
from jaxunshear.errors import UserError
from jaxunshear.files import Json

if TYPE_CHECKING:
    from jax import Array

    from jaxunshear.data.pairing import PoseEstimator, SlideSimulator, TapRenderer
    from jaxunshear.data.reader import Batch, Reader
    from jaxunshear.data.recorded_set import RecordedSet
    from jaxunshear.data.simulation import SimulationEngine
    from jaxunshear.data.stored_sets import SetReader


Teacher = Callable[["Array"], "Array"]  # images or pins (B, ...) -> outputs (B, K) of a PoseNet


class PinLayout(NamedTuple):
    """The pins of a sensor in its images, for networks over pins."""

    rest: np.ndarray  # (P, 2) px: the mean place over training taps
    radius_px: float
    size: int  # of the images, px


class Examples(NamedTuple):
    """What a network learns from."""

    reader: "Reader"
    targets: Targets
    pins: PinLayout
    per_epoch: int  # examples that count as one epoch: unlabelled slides count, too
    taps: "Reader | None" = None  # recorded ones with labels, if there are any
    slide_targets: Targets = ()  # what varies between the slides of the data
    load_teachers: tuple[Callable[[], Teacher], ...] = ()  # of the parts, if the source has some
    tasks: int = 0  # that `stimulus` numbers, and a network over pins is given


class Helpers(Protocol):
    """What trained networks and the simulator add to examples, loaded when it is needed."""

    def select_part(self, part: Experiment) -> "Helpers": ...

    def load_renderer(self) -> "TapRenderer": ...

    def load_teacher(self, shift: np.ndarray) -> "Teacher": ...

    def load_estimator(self) -> "PoseEstimator": ...

    def load_simulator(self, stored: "RecordedSet") -> "SlideSimulator": ...


class DataSource:
    """The contacts of an experiment, which its settings `paired` describe.

    A source must have `read_rows`. One that keeps sets on disk, or has tests of its own, overrides
    more.
    """

    # a function of experiment, run_dir and data_dir, as `module:function`: scores a run's networks
    evaluator: ClassVar[str] = ""
    # what a batch has in addition: of pairs, and for networks over pins
    pair_fields: ClassVar[tuple[str, ...]] = ()
    pin_fields: ClassVar[tuple[str, ...]] = ()
    # in the frame of which labels networks predict poses
    pose_frame: ClassVar[str] = (
        "Poses have the names, the frame and the units of the recorded labels "
        "that the networks learnt from."
    )
    # whether a model also predicts poses of slides directly, by `posenet_sheared`
    predicts_directly: ClassVar[bool] = True
    # whether a run keeps what the frames of its sensor have in common (`read_frame`)
    has_frame: ClassVar[bool] = False
    # the function that runs the stages of an experiment, as `module:function`
    runner: ClassVar[str] = "jaxunshear.run:run_stages"

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.settings: Any = experiment.paired
        # whether poses share slides, so that a batch can have the partners of `FactorialReader`
        self.shares_slides = getattr(self.settings, "poses_a_slide", 1) > 1

    def read_rows(self, split: str) -> "Batch":
        """Read all pairs of a split.

        The fields are `canonical` and `sheared`, images (N, S, S) uint8 of {0, 255}; `pose` (N, 6)
        mm and deg, NaN where unknown; and `move` (N, 6), the slides, if they are known.
        """
        raise NotImplementedError

    def list_sets(self) -> dict[str, DataSettings]:
        """List the settings of all sets that must be made before a training, by name."""
        return {}

    def make_sets(
        self, data_dir: Path, engine: "SimulationEngine | None" = None
    ) -> dict[str, Json]:
        """Make the sets of `list_sets` that are missing; returns their metadata by name."""
        from jaxunshear.data.stored_sets import make_set

        sensor = self.experiment.sensor
        return {
            name: make_set(settings, sensor, data_dir, engine)
            for name, settings in self.list_sets().items()
        }

    def list_digests(self, settings: DataSettings) -> set[str]:
        """List the digests of a set that a network learns from."""
        return {compute_fingerprint(settings, self.experiment.sensor)}

    def list_test_digests(self) -> set[str]:
        """List the digests of data that are for tests, so that no network may learn from them."""
        return set()

    def describe_origin(self, config: NetworkConfig) -> Json:
        """Describe the data set that a network is to learn from, and how it uses that set."""
        return describe_set(config.source, config.sensor)

    def open_examples(self, config: NetworkConfig, data_dir: Path, helpers: Helpers) -> Examples:
        """Open what a network learns from. Raises UserError if data are missing or damaged."""
        from jaxunshear.data.reader import Reader

        if config.modality == "pins":
            raise UserError("unshear.input pins: this data source has images alone")

        def load(split: str) -> "Batch":
            rows = self.read_rows(split)
            number = np.arange(len(rows["canonical"]), dtype=np.int32)
            image = {"image": rows["canonical"]} if config.spec.learns_from == "taps" else {}
            return {"stimulus": np.zeros_like(number), "pose_id": number, **image, **rows}

        size = self.settings.preprocess.size
        reader = Reader(load, size)
        rows = reader.rows("train")
        unknown = np.full_like(rows["pose"], np.nan)
        return Examples(
            reader,
            make_label_targets(config.targets, rows["pose"], rows.get("move")),
            PinLayout(np.zeros((0, 2), np.float32), 0.0, size),
            reader.length("train"),
            slide_targets=make_move_targets(rows.get("move", unknown)),
        )

    def evaluate(self, run_dir: Path, data_dir: Path) -> Any:
        """Score the networks in `run_dir` on contacts that were kept out of their training."""
        if not self.evaluator:
            raise UserError(
                f"{type(self.settings).__name__} has no test: set `evaluator` in its data source"
            )
        return pkgutil.resolve_name(self.evaluator)(self.experiment, run_dir, data_dir)

    @property
    def suits_recordings(self) -> bool:
        """Whether the networks suit frames of a real camera."""
        return True

    def describe(self) -> str:
        """Describe in one line what networks learnt from, and what that means for recordings."""
        return f"These networks learnt from {type(self.settings).__name__}."

    def read_frame(self, data_dir: Path) -> Json | None:
        """Read what the frames of a real sensor have in common, which a run keeps."""
        return None

    def make_pose_targets(self, data_dir: Path) -> Targets:
        """Make the targets of all components of the pose that the data vary. Raises UserError."""
        raise UserError(f"'{self.experiment.name}' has no pins, which probes compare codes with")


class SimulatedSource(DataSource):
    """Simulated pairs and taps: `PairedData` and `PoseData`."""

    evaluator = "jaxunshear.evaluation.simulated_evaluation:evaluate_simulation"
    pose_frame = (
        "x_mm and yaw_deg are relative to the simulated stimulus' target point, "
        "edge_mm (negative inside) and edge_deg give the nearest edge in the sensor frame; "
        "recorded_* are the labels that came with the images, in their own work frame."
    )
    predicts_directly = False

    @property
    def suits_recordings(self) -> bool:
        """Whether the networks learnt from pins as other sensors and cameras would show them."""
        experiment = self.experiment
        return experiment.unshear.input == "pins" and experiment.pins.rotated_share > 0

    def describe(self) -> str:
        sensor, names = self.experiment.sensor.name, ", ".join(self.settings.names)
        simulated = f"These networks were trained on simulated contacts alone ({sensor}; {names})"
        if self.suits_recordings:
            return (
                f"{simulated}, whose sensor and camera vary at random. "
                "Offset and sign of each output are arbitrary "
                "(`jaxunshear evaluate MODEL --recordings DIR` estimates them for its scores). "
                "Networks that learn from your own recordings are more exact (`jaxunshear fit`)."
            )
        return (
            f"{simulated}: for recordings take the weights `skin`, "
            "or learn from your own with `jaxunshear fit`."
        )

    def list_sets(self) -> dict[str, DataSettings]:
        sets: dict[str, DataSettings] = {self.settings.set_name: self.settings}
        if takes_taps(self.experiment):
            sets[PoseData.set_name] = cast(PoseData, self.experiment.pose)
        return sets | list_further_tests(self.experiment)

    def list_test_digests(self) -> set[str]:
        tests = list_further_tests(self.experiment).values()
        return {digest for test in tests for digest in self.list_digests(test)}

    def open_examples(self, config: NetworkConfig, data_dir: Path, helpers: Helpers) -> Examples:
        settings = cast(PairedData | PoseData, config.source)
        reader = self.open_set(settings, data_dir)
        size, is_paired = settings.preprocess.size, config.spec.learns_from != "taps"
        rest = np.zeros((0, 2), np.float32)
        if config.modality == "pins":
            # the rest positions of recordings are means over taps, for want of untouched pins
            pins = reader.rows("train")["canonical_pins" if is_paired else "pins"]
            rest = pins.mean(axis=0, dtype=np.float64)
        radius_px = config.sensor.pin_radius_mm * size / settings.camera.mm_across
        return Examples(
            reader,
            make_range_targets(config.targets, settings.ranges),
            PinLayout(rest, radius_px, size),
            reader.length("train"),
            slide_targets=make_slide_targets(settings.ranges) if is_paired else (),
        )

    def make_pose_targets(self, data_dir: Path) -> Targets:
        return make_range_targets((), self.settings.ranges, tuple(SIMULATED_FIELDS))

    def open_set(self, settings: DataSettings, data_dir: Path) -> "SetReader":
        """Open a set. Raises UserError if it is missing or was made with other settings."""
        from jaxunshear.data.stored_sets import FactorialReader, SetReader, open_set

        is_factorial = self.shares_slides and settings == self.settings
        kind = FactorialReader if is_factorial else SetReader
        return open_set(settings, data_dir, self.experiment.sensor, kind)


def open_source(experiment: Experiment) -> DataSource:
    """Open the data source that an experiment's settings `paired` name."""
    source = experiment.paired.source
    kind = pkgutil.resolve_name(source) if isinstance(source, str) else source
    opened: DataSource = kind(experiment)
    return opened


Source = TypeVar("Source", bound=type[DataSource])


def register_source(settings: type[SourceSettings]) -> Callable[[Source], Source]:
    """Register a class as the data source of experiments whose `paired` is of type `settings`.

    The class has a function at least. Raises UserError if other settings have this name.
    """

    def register(source: Source) -> Source:
        functions = (each for each in vars(source).values() if isinstance(each, FunctionType))
        file = next(functions).__code__.co_filename
        claim_name("data source", settings.__name__, SourceSettings.registered, file)
        settings.source = source
        SourceSettings.registered[settings.__name__] = settings
        return source

    return register
