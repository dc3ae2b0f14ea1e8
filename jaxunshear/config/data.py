"""Sizes and ranges of the two simulated data sets, and what of recordings is used."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

from jaxunshear.config.image import Camera, Nuisance, Preprocess
from jaxunshear.config.splits import BLOCK
from jaxunshear.config.stimuli import StimulusSetting, list_stimulus_names
from jaxunshear.config.types import Rule

PairingMethod = Literal["rendered", "nearest", "pose_id", "file", "simulated"]
SplitMethod = Literal["random", "block", "folder"]
SPLIT_TEXTS: dict[str, str] = {  # what each way of splitting keeps out, in a report's words
    "random": "random split",
    "block": "block of poses",
    "folder": "split by folders",
}
MAX_TWIST_DEG = 90.0
MAX_SEED = 2**31 - 1


def make_seed_rule(seed: int) -> Rule:
    return 0 <= seed <= MAX_SEED, "seed", f"use an integer from 0 to {MAX_SEED}"


@dataclass(frozen=True)
class Ranges:
    """Paper section 3.2: uniform ranges of the poses about the target contact point, and of the slides."""

    lateral_mm: float = 5.0  # x and y within +- this
    yaw_deg: float = 45.0  # the text's "[-45, -45]" read as +-45
    depth_min_mm: float = 1.0  # indentation depth from this
    depth_max_mm: float = 6.0  # to this
    move_mm: float = 2.5  # slide offset within +- this, along x or y or both, as chance has it
    # a slide turns within +- this while it moves, and ends at the pose's yaw
    twist_deg: float = 0.0
    # the sensor leans by up to this, any way: the same from first touch to the slide's end
    tilt_deg: float = 0.0

    def rules(self) -> Iterator[Rule]:
        """What a sensor can reach is for `rules.py`."""
        for name in ("lateral_mm", "move_mm", "tilt_deg"):
            yield getattr(self, name) >= 0, name, "must not be below zero"
        yield 0 <= self.yaw_deg <= 180, "yaw_deg", "use 0 to 180"
        yield 0 <= self.twist_deg <= MAX_TWIST_DEG, "twist_deg", f"use 0 to {MAX_TWIST_DEG:g}"
        yield (
            self.depth_min_mm > 0,
            "depth_min_mm",
            "must be above zero: at its top or above it the stimulus is not touched",
        )
        yield (
            self.depth_min_mm <= self.depth_max_mm,
            "depth_min_mm",
            f"must not exceed depth_max_mm ({self.depth_max_mm:g})",
        )


DRIFTING_NUISANCE = Nuisance(
    drift_px=1.0, drift_brightness=0.1
)  # a set is recorded over days (paper section 3.2.2)


@dataclass(frozen=True)
class PairedData:
    """`tactip_paired`: for every pose `taps` canonical images and `slides` sheared ones."""

    config: str = "demo"  # name of the stored configuration; changed fields get a name of their own
    stimuli: tuple[StimulusSetting, ...] = ("disk", "clover", "teardrop")  # shapes that are touched
    poses: int = 600  # per stimulus
    taps: int = 1  # canonical images a pose
    slides: int = 2  # sheared images a pose
    poses_a_slide: int = 1  # so many poses of a split share their slides (`data/factorial.py`)
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
        """Of the stimuli."""
        return list_stimulus_names(self.stimuli)

    def rules(self) -> Iterator[Rule]:
        yield from _list_simulated_rules(self)
        yield self.taps >= 1, "taps", "use at least 1: a sheared image needs a tap to pair with"
        yield (
            self.poses_a_slide >= 1,
            "poses_a_slide",
            "use at least 1: a slide belongs to one pose at least",
        )
        yield (
            self.slides >= 1,
            "slides",
            "use at least 1: without slides there is nothing to unshear",
        )
        yield (
            self.taps <= self.slides,
            "taps",
            f"exceeds slides ({self.slides}): some would never be paired",
        )
        yield (
            0 <= self.tap_depth_jitter_mm <= self.ranges.depth_min_mm,
            "tap_depth_jitter_mm",
            f"use 0 to ranges.depth_min_mm ({self.ranges.depth_min_mm:g}), or a tap may miss the stimulus",
        )


@dataclass(frozen=True)
class PoseData:
    """`tactip_pose`: taps at poses of their own, drawn separately (paper section 3.2.2)."""

    config: str = "demo"
    stimuli: tuple[StimulusSetting, ...] = ("disk", "clover", "teardrop")  # shapes that are touched
    poses: int = 2400  # per stimulus
    seed: int = 1  # of the poses: another than the pairs'
    friction: float | None = None  # of all stimuli; None: that of each one's material
    ranges: Ranges = field(default_factory=Ranges)
    camera: Camera = field(default_factory=Camera)
    nuisance: Nuisance = DRIFTING_NUISANCE
    preprocess: Preprocess = field(default_factory=Preprocess)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the stimuli."""
        return list_stimulus_names(self.stimuli)

    def rules(self) -> Iterator[Rule]:
        yield from _list_simulated_rules(self)


def _list_simulated_rules(data: PairedData | PoseData) -> Iterator[Rule]:
    yield len(data.stimuli) > 0, "stimuli", "name at least one"
    yield len(set(data.names)) == len(data.names), "stimuli", "name each stimulus once"
    yield (
        data.poses >= BLOCK,
        "poses",
        f"use at least {BLOCK}, so that each of the three splits gets a pose",
    )
    yield make_seed_rule(data.seed)
    yield (
        data.friction is None or data.friction >= 0,
        "friction",
        "use 0 or more, or none for each material's own",
    )
    camera, nuisance = data.camera, data.nuisance
    yield (
        data.preprocess.size <= camera.frame_px,
        "preprocess.size",
        f"larger than the camera's frame of {camera.frame_px} px: use a smaller size or a larger camera.frame_px",
    )
    for name, most in (("blur_px", camera.frame_px / 8), ("drift_px", camera.frame_px / 4)):
        yield (
            0 <= getattr(nuisance, name) <= most,
            f"nuisance.{name}",
            f"use 0 to {most:g} for a frame of {camera.frame_px} px",
        )


RENDERED_PAIRINGS = (
    "rendered",
    "simulated",
)  # pairings that take a renderer; the latter for test slides alone


@dataclass(frozen=True)
class Recorded:
    """`tactip_recorded` in the place of `PairedData`: recorded slides, each with a tap to be unsheared to.

    Both folders may be one: labels say which is which. `split` chooses what is kept out of training:
    "random": folders named `*val*` and `*test*`; what they leave open is drawn at random by pose.
    "block": poses whose label lies in an interval are the test, those on either side of it are
    for validation, so that no training pose is near a test pose (`data/pose_block.py`).
    "folder": folders so named alone; an error if there is none.
    """

    tap_folder: str = ""  # none: there are no taps
    slide_folder: str = ""  # may be the same: labels say which is which
    digest: str = ""  # of what lies there; found when the recordings are named
    pairs: str = ""  # table of pairs, columns slide and tap, for pairing "file"
    # a slide's partner: "rendered", what a renderer, learnt from taps, draws at its pose; "nearest"; "pose_id"; "file"; or "simulated":
    # the slides that teach are simulated, recorded ones test alone
    pairing: PairingMethod = "rendered"
    labelled: float = 1.0  # share of the training slides whose labels teach
    # training slides without a label; "read": posenet_sheared reads their poses
    unlabelled: Literal["left_out", "read"] = "left_out"
    # taps that posenet_sheared, which learns poses of slides directly, learns from as well: the
    # recorded ones, as slides of length zero; or over pins as many rendered ones as slides
    direct_taps: Literal["none", "recorded", "rendered"] = "none"
    # what validation and test keep out: poses drawn at random; a block of poses, which has no near
    # neighbours in training; or "folder", folders called *val* and *test* alone
    split: SplitMethod = "random"
    test: float = 0.1  # share of the poses kept out, where no folder is
    validation: float = 0.1  # likewise, for the choice of the best state
    seed: int = 0  # of that draw, or of the block's place
    preprocess: Preprocess = field(default_factory=Preprocess)

    def rules(self) -> Iterator[Rule]:
        yield (
            bool(self.tap_folder or self.slide_folder),
            "tap_folder",
            "name your recordings: add --recordings DIR",
        )
        yield (
            bool(self.pairs) == (self.pairing == "file"),
            "pairs",
            "a table of pairs goes with pairing file: add both, or neither",
        )
        yield (
            self.pairing != "simulated" or (self.labelled == 1 and self.unlabelled == "left_out"),
            "pairing",
            "simulated takes no recorded slide to learn from: leave labelled at 1 and unlabelled at left_out",
        )
        yield (
            self.direct_taps == "none" or self.pairing != "simulated",
            "direct_taps",
            "adds taps to recorded slides: leave it at none with pairing simulated",
        )
        yield 0 < self.labelled <= 1, "labelled", "use a share above 0, at most 1"
        yield (
            self.unlabelled == "left_out" or self.pairing in ("rendered", "nearest"),
            "unlabelled",
            f"poses that are read give no partner for pairing {self.pairing}: use pairing rendered or nearest",
        )
        for name in ("test", "validation"):
            yield 0 < getattr(self, name) < 0.5, name, "use a share between 0 and 0.5"
        yield make_seed_rule(self.seed)


@dataclass(frozen=True)
class RecordedTaps:
    """In the place of `PoseData`: the taps of the recordings that `Recorded` names."""
