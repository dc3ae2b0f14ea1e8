"""Settings of the two simulated data sets, and of recordings."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

from jaxunshear.config.image import Camera, Nuisance, Preprocess
from jaxunshear.config.splits import BLOCK
from jaxunshear.config.stimuli import StimulusSetting, list_stimulus_names
from jaxunshear.config.types import Rule

PairingMethod = Literal["rendered", "nearest", "pose_id", "file", "simulated"]
SplitMethod = Literal["random", "block", "folder"]
SPLIT_TEXTS: dict[str, str] = {  # how a report says what each method keeps out of training
    "random": "random split",
    "block": "block of poses",
    "folder": "split by folders",
}
MAX_TWIST_DEG = 90.0
MAX_SEED = 2**31 - 1


def make_seed_rule(seed: int) -> Rule:
    return Rule(0 <= seed <= MAX_SEED, "seed", f"use an integer from 0 to {MAX_SEED}")


@dataclass(frozen=True)
class Ranges:
    """Ranges from which poses and slides are drawn uniformly (paper section 3.2)."""

    lateral_mm: float = 5.0  # x and y within +- this
    yaw_deg: float = 45.0  # the text's "[-45, -45]" read as +-45
    depth_min_mm: float = 1.0  # indentation depth from this
    depth_max_mm: float = 6.0  # to this
    move_mm: float = 2.5  # slide offset within +- this, along x or y or both, as chance has it
    # a slide turns within +- this while it moves, and ends at the pose's yaw
    twist_deg: float = 0.0
    # the sensor leans by up to this in any direction, from first touch to the slide's end alike
    tilt_deg: float = 0.0

    def rules(self) -> Iterator[Rule]:
        """Yield the rules that hold for any sensor; `rules_simulated.py` has those of its reach."""
        for name in ("lateral_mm", "move_mm", "tilt_deg"):
            yield Rule(getattr(self, name) >= 0, name, "must not be below zero")
        yield Rule(0 <= self.yaw_deg <= 180, "yaw_deg", "use 0 to 180")
        yield Rule(0 <= self.twist_deg <= MAX_TWIST_DEG, "twist_deg", f"use 0 to {MAX_TWIST_DEG:g}")
        yield Rule(
            self.depth_min_mm > 0,
            "depth_min_mm",
            "must be above zero: at its top or above it the stimulus is not touched",
        )
        yield Rule(
            self.depth_min_mm <= self.depth_max_mm,
            "depth_min_mm",
            f"must not exceed depth_max_mm ({self.depth_max_mm:g})",
        )


# a set is recorded over days (paper section 3.2.2)
DRIFTING_NUISANCE = Nuisance(drift_px=1.0, drift_brightness=0.1)


@dataclass(frozen=True)
class PairedData:
    """The set `tactip_paired`: for every pose `taps` canonical images and `slides` sheared ones."""

    config: str = "demo"  # name of the stored configuration; changed fields get a name of their own
    stimuli: tuple[StimulusSetting, ...] = ("disk", "clover", "teardrop")  # shapes that are touched
    poses: int = 600  # per stimulus
    taps: int = 1  # canonical images a pose
    slides: int = 2  # sheared images a pose
    poses_a_slide: int = 1  # poses of a split that share their slides (`data/factorial.py`)
    # a tap misses its slide's depth by up to this (the paper: 1.0)
    tap_depth_jitter_mm: float = 0.0
    seed: int = 0  # of poses and slides
    friction: float | None = None  # of all stimuli; None: that of each one's material
    ranges: Ranges = field(default_factory=Ranges)
    camera: Camera = field(default_factory=Camera)
    nuisance: Nuisance = DRIFTING_NUISANCE
    preprocess: Preprocess = field(default_factory=Preprocess)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the stimuli."""
        return list_stimulus_names(self.stimuli)

    def rules(self) -> Iterator[Rule]:
        yield from _list_simulated_rules(self)
        yield Rule(
            self.taps >= 1, "taps", "use at least 1: a sheared image needs a tap to pair with"
        )
        yield Rule(
            self.poses_a_slide >= 1,
            "poses_a_slide",
            "use at least 1: a slide belongs to one pose at least",
        )
        yield Rule(
            self.slides >= 1,
            "slides",
            "use at least 1: without slides there is nothing to unshear",
        )
        yield Rule(
            self.taps <= self.slides,
            "taps",
            f"exceeds slides ({self.slides}): some would never be paired",
        )
        yield Rule(
            0 <= self.tap_depth_jitter_mm <= self.ranges.depth_min_mm,
            "tap_depth_jitter_mm",
            f"use 0 to ranges.depth_min_mm ({self.ranges.depth_min_mm:g}), "
            "or a tap may miss the stimulus",
        )


@dataclass(frozen=True)
class PoseData:
    """The set `tactip_pose`: taps at poses drawn separately from the pairs' (section 3.2.2)."""

    config: str = "demo"
    stimuli: tuple[StimulusSetting, ...] = ("disk", "clover", "teardrop")  # shapes that are touched
    poses: int = 2400  # per stimulus
    seed: int = 1  # of the poses; another than that of the pairs
    friction: float | None = None  # of all stimuli; None: that of each one's material
    ranges: Ranges = field(default_factory=Ranges)
    camera: Camera = field(default_factory=Camera)
    nuisance: Nuisance = DRIFTING_NUISANCE
    preprocess: Preprocess = field(default_factory=Preprocess)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the stimuli."""
        return list_stimulus_names(self.stimuli)

    def rules(self) -> Iterator[Rule]:
        yield from _list_simulated_rules(self)


def _list_simulated_rules(data: PairedData | PoseData) -> Iterator[Rule]:
    yield Rule(len(data.stimuli) > 0, "stimuli", "name at least one")
    yield Rule(len(set(data.names)) == len(data.names), "stimuli", "name each stimulus once")
    yield Rule(
        data.poses >= BLOCK,
        "poses",
        f"use at least {BLOCK}, so that each of the three splits gets a pose",
    )
    yield make_seed_rule(data.seed)
    yield Rule(
        data.friction is None or data.friction >= 0,
        "friction",
        "use 0 or more, or none for each material's own",
    )
    camera, nuisance = data.camera, data.nuisance
    yield Rule(
        data.preprocess.size <= camera.frame_px,
        "preprocess.size",
        f"larger than the camera's frame of {camera.frame_px} px: "
        "use a smaller size or a larger camera.frame_px",
    )
    for name, most in (("blur_px", camera.frame_px / 8), ("drift_px", camera.frame_px / 4)):
        yield Rule(
            0 <= getattr(nuisance, name) <= most,
            f"nuisance.{name}",
            f"use 0 to {most:g} for a frame of {camera.frame_px} px",
        )


# pairings that need a renderer; "simulated" for test slides alone
RENDERED_PAIRINGS = ("rendered", "simulated")


@dataclass(frozen=True)
class Recorded:
    """The set `tactip_recorded`, which replaces `PairedData`: recorded slides, each with a tap.

    `split` chooses what is kept out of training:

    * "random": folders named `*val*` and `*test*`; poses at random for a split without a folder.
    * "block": poses whose label lies in an interval are for test, those on either side of it for
      validation, so that no training pose is near a test pose (`data/pose_block.py`).
    * "folder": folders so named alone; an error if there is none.
    """

    tap_folder: str = ""  # empty: there are no taps
    slide_folder: str = ""  # may be the tap folder: labels distinguish slides from taps
    digest: str = ""  # of the files there; computed when the recordings are named
    pairs: str = ""  # table of pairs, columns slide and tap, for pairing "file"
    # a slide's partner: "rendered": what a renderer, trained on taps, draws at its pose; "nearest":
    # the tap of the nearest pose; "pose_id" and "file": a recorded tap; "simulated": training
    # slides are simulated, and recorded ones are for tests alone
    pairing: PairingMethod = "rendered"
    labelled: float = 1.0  # share of the training slides whose labels are used
    # training slides without a label; "read": posenet_sheared reads their poses
    unlabelled: Literal["left_out", "read"] = "left_out"
    # taps that posenet_sheared, which learns poses of slides directly, learns from as well: the
    # recorded ones, as slides of length zero; or over pins as many rendered ones as slides
    direct_taps: Literal["none", "recorded", "rendered"] = "none"
    # kept out of training: poses at "random", a "block" of poses that are close, or a "folder"
    split: SplitMethod = "random"
    test: float = 0.1  # share of the poses for test, if no folder is
    validation: float = 0.1  # likewise, to choose the best checkpoint
    seed: int = 0  # of that draw, or of the block's place
    preprocess: Preprocess = field(default_factory=Preprocess)

    def rules(self) -> Iterator[Rule]:
        yield Rule(
            bool(self.tap_folder or self.slide_folder),
            "tap_folder",
            "name your recordings: add --recordings DIR",
        )
        yield Rule(
            bool(self.pairs) == (self.pairing == "file"),
            "pairs",
            "a table of pairs goes with pairing file: add both, or neither",
        )
        yield Rule(
            self.pairing != "simulated" or (self.labelled == 1 and self.unlabelled == "left_out"),
            "pairing",
            "simulated takes no recorded slide to learn from: "
            "leave labelled at 1 and unlabelled at left_out",
        )
        yield Rule(
            self.direct_taps == "none" or self.pairing != "simulated",
            "direct_taps",
            "adds taps to recorded slides: leave it at none with pairing simulated",
        )
        yield Rule(0 < self.labelled <= 1, "labelled", "use a share above 0, at most 1")
        yield Rule(
            self.unlabelled == "left_out" or self.pairing in ("rendered", "nearest"),
            "unlabelled",
            f"poses that are read give no partner for pairing {self.pairing}: "
            "use pairing rendered or nearest",
        )
        for name in ("test", "validation"):
            yield Rule(0 < getattr(self, name) < 0.5, name, "use a share between 0 and 0.5")
        yield make_seed_rule(self.seed)


@dataclass(frozen=True)
class RecordedTaps:
    """The taps of the recordings that `Recorded` names; replaces `PoseData`."""
