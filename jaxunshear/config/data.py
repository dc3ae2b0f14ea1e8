"""Settings of data sources: the two simulated data sets, and recordings."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, cast

from jaxunshear.config.networks import POSENET_SHEARED, RENDERER, NetworkSpec
from jaxunshear.config.sensor import Camera, Nuisance, Preprocess
from jaxunshear.config.splits import BLOCK, count_train_poses
from jaxunshear.config.stimuli import StimulusSetting, list_stimulus_names
from jaxunshear.config.types import Bound, Count, NotNegative, Positive, Problem, Share, between
from jaxunshear.errors import UserError

PairingMethod = Literal["rendered", "nearest", "pose_id", "file", "simulated"]
SplitMethod = Literal["random", "block", "folder", "edge_2d", "surface_3d"]
FROZEN_SPLITS: tuple[SplitMethod, ...] = (
    "edge_2d",
    "surface_3d",
)  # as data/frozen_splits.toml names them
SPLIT_TEXTS: dict[str, str] = {  # how a report says what each method keeps out of training
    "random": "random split",
    "block": "block of poses",
    "folder": "split by folders",
    **{name: f"frozen split {name}" for name in FROZEN_SPLITS},
}
MAX_SEED = 2**31 - 1
Seed = Annotated[int, between(0, MAX_SEED)]
Poses = Annotated[
    int,
    Bound(
        lambda poses: poses >= BLOCK,
        f"use at least {BLOCK}, so that each of the three splits gets a pose",
    ),
]
Half = Annotated[float, Bound(lambda share: 0 < share < 0.5, "use a share between 0 and 0.5")]


@dataclass(frozen=True)
class Ranges:
    """Ranges from which poses and slides are drawn uniformly (paper section 3.2)."""

    lateral_mm: NotNegative = 5.0  # x and y within +- this
    # yaw within +- this; the paper has "[-45, -45]"
    yaw_deg: Annotated[float, between(0, 180)] = 45.0
    depth_min_mm: Positive = 1.0  # smallest indentation depth
    depth_max_mm: float = 6.0  # largest indentation depth
    move_mm: NotNegative = 2.5  # slide offset within +- this, along x or y or both, by chance
    # a slide turns within +- this while it moves, and ends at the pose's yaw
    twist_deg: Annotated[float, between(0, 90)] = 0.0
    # the sensor leans by up to this in any direction, from first touch to the slide's end alike
    tilt_deg: NotNegative = 0.0

    def find_problems(self) -> Iterator[Problem]:
        """Find problems with any sensor; `rules_simulated.py` finds those with its reach."""
        if not self.depth_min_mm <= self.depth_max_mm:
            yield "depth_min_mm", f"must not exceed depth_max_mm ({self.depth_max_mm:g})"


# a set is recorded over days (paper section 3.2.2)
DRIFTING_NUISANCE = Nuisance(drift_px=1.0, drift_brightness=0.1)


class DataSettings:
    """Settings of a set of contacts, which may be stored on disk."""

    set_name: ClassVar[str] = ""
    version: ClassVar[str] = ""  # of the stored set; raise it whenever equal settings give new bits
    # fields that do not decide the bits of the set: names, and how trainings use it
    not_stored: ClassVar[tuple[str, ...]] = ()
    preprocess: Preprocess = Preprocess()


class SourceSettings(DataSettings):
    """Settings of a data source, as an experiment's `paired`; docs/extending.md adds one."""

    registered: ClassVar[dict[str, type["SourceSettings"]]] = {}
    # the DataSource of data/sources.py that reads it, or its place, as `module:class`
    source: ClassVar[type | str] = ""
    is_simulated: ClassVar[bool] = False
    contacts: ClassVar[str] = "other data"  # what networks learn from, in messages
    has_parts: ClassVar[bool] = False  # each part trains the networks that others learn from

    def require_simulation(self, what: str) -> "PairedData":
        """Return the settings of simulated contacts. Raises UserError, as `what` needs these."""
        raise UserError(
            f"{what} needs a model of simulated touches: this one learnt from {self.contacts}"
        )

    def list_helpers(self, spec: NetworkSpec, adds_rendered: bool) -> tuple[str, ...]:
        """List the networks that a network learns from, by its data.

        `adds_rendered`: networks that learn from taps also learn from rendered ones.
        """
        return ()

    def select_for(self, spec: NetworkSpec, pose: object) -> DataSettings:
        """Select the set that a network learns from, settings that it does not use at defaults."""
        return self


@dataclass(frozen=True)
class SimulatedData(DataSettings):
    """Settings that both simulated sets have."""

    version: ClassVar[str] = "3.0.0"
    not_stored: ClassVar[tuple[str, ...]] = ("config",)

    config: str = "demo"  # name of the stored configuration; changed fields get a name of their own
    stimuli: tuple[StimulusSetting, ...] = ("disk", "clover", "teardrop")  # shapes that are touched
    poses: Poses = 600  # poses per stimulus
    # seed of poses and slides; it must differ between pairs and the taps of PoseNets
    seed: Seed = 0
    friction: float | None = None  # friction coefficient; none: that of each stimulus's material
    ranges: Ranges = field(default_factory=Ranges)
    camera: Camera = field(default_factory=Camera)
    nuisance: Nuisance = DRIFTING_NUISANCE
    preprocess: Preprocess = field(default_factory=Preprocess)

    @property
    def names(self) -> tuple[str, ...]:
        return list_stimulus_names(self.stimuli)

    def count_training_poses(self) -> int:
        return sum(count_train_poses(self.seed, name, self.poses) for name in self.names)

    def find_problems(self) -> Iterator[Problem]:
        if not self.stimuli:
            yield "stimuli", "name at least one"
        if len(set(self.names)) < len(self.names):
            yield "stimuli", "name each stimulus once"
        if self.friction is not None and not self.friction >= 0:
            yield "friction", "use 0 or more, or none for each material's own"
        frame_px = self.camera.frame_px
        if self.preprocess.size > frame_px:
            remedy = "use a smaller size or a larger camera.frame_px"
            yield "preprocess.size", f"larger than the camera's frame of {frame_px} px: {remedy}"
        for name, most in (("blur_px", frame_px / 8), ("drift_px", frame_px / 4)):
            if not 0 <= getattr(self.nuisance, name) <= most:
                yield f"nuisance.{name}", f"use 0 to {most:g} for a frame of {frame_px} px"


@dataclass(frozen=True)
class PairedData(SimulatedData, SourceSettings):
    """The set `tactip_paired`: for every pose `taps` canonical images and `slides` sheared ones."""

    set_name: ClassVar[str] = "tactip_paired"
    source: ClassVar[type | str] = "jaxunshear.data.sources:SimulatedSource"
    is_simulated: ClassVar[bool] = True

    taps: Count = 1  # canonical images per pose
    slides: Count = 2  # sheared images per pose
    # poses of a split that share their slides, so that codes can be swapped
    poses_a_slide: Count = 1
    # how far a tap may miss its slide's depth, mm (the paper: 1.0)
    tap_depth_jitter_mm: float = 0.0

    def require_simulation(self, what: str) -> "PairedData":
        return self

    def select_for(self, spec: NetworkSpec, pose: object) -> DataSettings:
        return cast(PoseData, pose) if spec.learns_from == "taps" else self

    def find_problems(self) -> Iterator[Problem]:
        yield from super().find_problems()
        if self.taps > self.slides:
            yield "taps", f"exceeds slides ({self.slides}): some would never be paired"
        most = self.ranges.depth_min_mm
        if not 0 <= self.tap_depth_jitter_mm <= most:
            remedy = f"use 0 to ranges.depth_min_mm ({most:g}), or a tap may miss the stimulus"
            yield "tap_depth_jitter_mm", remedy


@dataclass(frozen=True)
class PoseData(SimulatedData):
    """The set `tactip_pose`: taps at poses drawn separately from the pairs' (section 3.2.2)."""

    set_name: ClassVar[str] = "tactip_pose"

    poses: Poses = 2400
    seed: Seed = 1


JOINT = "joint"  # the training of a network on all tasks, beside those of each
TASK_FOLDERS = (JOINT, "trained", "others", "taps_alone")  # in a run, beside one for each task
# pairings that need a renderer; "simulated" for test slides alone
RENDERED_PAIRINGS = ("rendered", "simulated")


@dataclass(frozen=True)
class Recorded(SourceSettings):
    """The set `tactip_recorded`, which replaces `PairedData`: recorded slides, each with a tap.

    `split` chooses what is kept out of training:

    * "random": folders named `*val*` and `*test*`; poses at random for a split without a folder.
    * "block": poses whose label lies in an interval are for test, those on either side of it for
      validation, so that no training pose is near a test pose (`data/recorded_splits.py`).
    * "folder": folders so named alone; an error if there is none.
    * "edge_2d" and "surface_3d": the frozen rows of these public sets (`data/frozen_splits.py`).
    """

    set_name: ClassVar[str] = "tactip_recorded"
    version: ClassVar[str] = "1.0.0"
    not_stored: ClassVar[tuple[str, ...]] = (
        *("tap_folder", "slide_folder", "pairs", "pairing"),
        *("labelled", "unlabelled", "direct_taps", "others"),
    )
    source: ClassVar[type | str] = "jaxunshear.data.recorded_source:RecordedSource"
    contacts: ClassVar[str] = "recordings"

    tap_folder: str = ""  # folder of the taps; empty: there are none
    # folder of the slides; may be that of the taps: labels distinguish them
    slide_folder: str = ""
    digest: str = ""  # of the files there; computed when the recordings are named
    pairs: str = ""  # table of pairs, columns slide and tap, for pairing "file"
    # digests of the recordings of other tasks that the network that unshears learnt from, too
    others: tuple[str, ...] = ()
    # a slide's partner: "rendered": what a renderer, trained on taps, draws at its pose; "nearest":
    # the tap of the nearest pose; "pose_id" and "file": a recorded tap; "simulated": training
    # slides are simulated, and recorded ones are for tests alone
    pairing: PairingMethod = "rendered"
    labelled: Share = 1.0  # share of the training slides whose labels are used
    # what becomes of training slides without a label: they are left out, or posenet_sheared
    # predicts their poses ("pseudo_label")
    unlabelled: Literal["left_out", "pseudo_label"] = "left_out"
    # taps that posenet_sheared, which learns poses of slides directly, learns from as well: the
    # recorded ones, as slides of length zero; or over pins as many rendered ones as slides
    direct_taps: Literal["none", "recorded", "rendered"] = "none"
    # what is kept out of training: poses at "random", a "block" of poses that are close, a
    # "folder", or the frozen rows of a public set by its name
    split: SplitMethod = "random"
    test: Half = 0.1  # share of the poses for test, if no folder is
    # share of the poses that choose the best checkpoint, if no folder is
    validation: Half = 0.1
    seed: Seed = 0  # seed of the draw of kept-out poses, or of the block's place
    preprocess: Preprocess = field(default_factory=Preprocess)

    def find_problems(self) -> Iterator[Problem]:
        if not (self.tap_folder or self.slide_folder):
            yield "tap_folder", "name your recordings: add --recordings DIR"
        if bool(self.pairs) != (self.pairing == "file"):
            yield "pairs", "a table of pairs goes with pairing file: add both, or neither"
        usual = Recorded()
        drawn = self.test, self.validation, self.seed
        if self.split in FROZEN_SPLITS and drawn != (usual.test, usual.validation, usual.seed):
            yield "split", f"{self.split} has fixed rows: leave test, validation and seed alone"
        use = self.labelled, self.unlabelled, self.direct_taps
        if self.pairing == "simulated" and use != (1, "left_out", "none"):
            remedy = "leave labelled at 1, unlabelled at left_out and direct_taps at none"
            yield "pairing", f"simulated takes no recorded slide to learn from: {remedy}"
        if self.unlabelled == "pseudo_label" and self.pairing not in ("rendered", "nearest"):
            problem = f"poses that are read give no partner for pairing {self.pairing}"
            yield "unlabelled", f"{problem}: use pairing rendered or nearest"

    def list_helpers(self, spec: NetworkSpec, adds_rendered: bool) -> tuple[str, ...]:
        if spec.role == "unshears":
            reads = (POSENET_SHEARED,) if self.unlabelled == "pseudo_label" else ()
            return reads + ((RENDERER,) if self.pairing in RENDERED_PAIRINGS else ())
        if spec.learns_from == "slides":
            return (RENDERER,) if self.direct_taps == "rendered" else ()
        return (RENDERER,) if adds_rendered and spec.name != RENDERER else ()

    def select_for(self, spec: NetworkSpec, pose: object) -> DataSettings:
        takes_taps_alone = spec.learns_from == "taps"
        used = replace(
            self,
            labelled=1.0 if takes_taps_alone else self.labelled,
            direct_taps=self.direct_taps if spec.name == POSENET_SHEARED else "none",
        )
        if spec.role == "unshears":
            return used
        used = replace(used, others=())
        # of the pairings only posenet_sheared uses one, if it learns from simulated slides
        simulated = not takes_taps_alone and self.pairing == "simulated"
        pairing: PairingMethod = "simulated" if simulated else "rendered"
        return replace(used, pairing=pairing, pairs="", unlabelled="left_out")


@dataclass(frozen=True)
class RecordedTasks(SourceSettings):
    """Recordings of several tasks or days, or of sensors of one make: one network unshears all.

    Each has its own PoseNets, and is a `Recorded` as if it were alone.
    """

    version: ClassVar[str] = "1.0.0"
    source: ClassVar[type | str] = "jaxunshear.data.task_source:TaskSource"
    contacts: ClassVar[str] = "recordings"
    has_parts: ClassVar[bool] = True

    tasks: tuple[Recorded, ...] = ()  # the first gives the frame of the pins
    # names of the tasks, which their runs have; (): of their folders, numbered where they are equal
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.names:  # kept, as a part of the tasks would be numbered otherwise
            object.__setattr__(self, "names", self._name_folders())

    @property
    def preprocess(self) -> Preprocess:  # type: ignore[override]
        return self.tasks[0].preprocess if self.tasks else Preprocess()

    def _name_folders(self) -> tuple[str, ...]:
        paths = [Path(task.tap_folder or task.slide_folder) for task in self.tasks]
        folders = [re.sub(r"[^\w.-]", "_", path.name) for path in paths]
        counts = Counter([*folders, *TASK_FOLDERS])
        return tuple(
            f"{name}_{i + 1}" if counts[name] > 1 else name for i, name in enumerate(folders)
        )

    def find_problems(self) -> Iterator[Problem]:
        if len({*self.names, *TASK_FOLDERS}) < len(self.tasks) + len(TASK_FOLDERS):
            words = ", ".join(TASK_FOLDERS)
            yield "names", f"give each task a name of its own, and none of {words}"
        if bad := [name for name in self.names if not re.fullmatch(r"\w[\w.-]*", name)]:
            yield "names", f"'{bad[0]}' names a folder: use letters, digits, '-', '_' and '.'"
        if any(not task.tap_folder for task in self.tasks):
            yield "tasks", "record taps of each task: PoseNets and partners of slides need them"
        if len(self.tasks) < 2:
            yield "tasks", "name two folders of recordings or more: --recordings DIR DIR"
        if len({task.digest for task in self.tasks}) < len(self.tasks):
            yield "tasks", "name each recording once"
        if len({task.preprocess for task in self.tasks}) > 1:
            yield "tasks", "prepare the images of all tasks alike"

    def select_for(self, spec: NetworkSpec, pose: object) -> DataSettings:
        used = tuple(cast(Recorded, task.select_for(spec, pose)) for task in self.tasks)
        return replace(self, tasks=used)


@dataclass(frozen=True)
class RecordedTaps:
    """The taps of the source that `paired` names; replaces `PoseData`."""


SourceSettings.registered |= {kind.__name__: kind for kind in (PairedData, Recorded, RecordedTasks)}
