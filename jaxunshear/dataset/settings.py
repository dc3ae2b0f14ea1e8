"""Sizes and ranges of the two simulated data sets, and what of recordings is used. Imports no JAX."""

from dataclasses import dataclass, field

from jaxunshear.image.settings import Camera, Nuisance, Preprocess


@dataclass(frozen=True)
class Ranges:
    """Paper section 3.2: uniform ranges of the poses about the target contact point, and of the slides."""

    lateral_mm: float = 5.0  # x and y within +- this
    yaw_deg: float = 45.0  # the text's "[-45, -45]" read as +-45
    depth_min_mm: float = 1.0
    depth_max_mm: float = 6.0
    move_mm: float = 2.5  # slide offset within +- this, along x or y or both, as chance has it
    twist_deg: float = 0.0  # a slide turns within +- this while it moves, and ends at the pose's yaw
    tilt_deg: float = 0.0  # the sensor leans by up to this, any way: the same from first touch to the slide's end


DRIFTING = Nuisance(drift_px=1.0, drift_brightness=0.1)  # a set is recorded over days (paper section 3.2.2)


@dataclass(frozen=True)
class PairedData:
    """`tactip_paired`: for every pose `taps` canonical images and `slides` sheared ones."""

    config: str = "demo"  # name of the stored configuration; changed fields get a name of their own
    stimuli: tuple[str, ...] = ("disk", "clover", "teardrop")
    poses: int = 600  # per stimulus
    taps: int = 1
    slides: int = 2
    poses_a_slide: int = 1  # so many poses of a split share their slides (`dataset/factorial.py`)
    tap_depth_jitter_mm: float = 0.0  # the paper: 1.0
    seed: int = 0
    friction: float | None = None  # of all stimuli; None: that of each one's material
    ranges: Ranges = field(default_factory=Ranges)
    camera: Camera = field(default_factory=Camera)
    nuisance: Nuisance = DRIFTING
    preprocess: Preprocess = field(default_factory=Preprocess)


@dataclass(frozen=True)
class PoseData:
    """`tactip_pose`: taps at poses of their own, drawn separately (paper section 3.2.2)."""

    config: str = "demo"
    stimuli: tuple[str, ...] = ("disk", "clover", "teardrop")
    poses: int = 2400  # per stimulus
    seed: int = 1
    friction: float | None = None  # as in `PairedData`
    ranges: Ranges = field(default_factory=Ranges)
    camera: Camera = field(default_factory=Camera)
    nuisance: Nuisance = DRIFTING
    preprocess: Preprocess = field(default_factory=Preprocess)


PAIRINGS = ("rendered", "nearest", "pose_id", "file", "simulated")
RENDERED = ("rendered", "simulated")  # pairings that take a renderer; the latter for test slides alone
UNLABELLED = ("left_out", "read")


@dataclass(frozen=True)
class Recorded:
    """`tactip_recorded` in the place of `PairedData`: recorded slides, each with a tap to be unsheared to.

    Folders named `*val*` and `*test*` are those splits; what they leave open is drawn at random by pose. Both folders may be one:
    labels say which is which.
    """

    tap_folder: str = ""  # none: there are no taps
    slide_folder: str = ""
    digest: str = ""  # of what lies there; found when the recordings are named
    pairs: str = ""  # table of pairs, columns slide and tap, for pairing "file"
    # a slide's partner: "rendered", what a renderer, learnt from taps, draws at its pose; "nearest"; "pose_id"; "file"; or "simulated":
    # the slides that teach are simulated, recorded ones test alone
    pairing: str = "rendered"
    labelled: float = 1.0  # share of the training slides whose labels teach
    unlabelled: str = "left_out"  # training slides without a label; or "read": posenet_sheared reads their poses
    test: float = 0.1  # share of the poses kept out, where no folder is
    validation: float = 0.1
    seed: int = 0
    preprocess: Preprocess = field(default_factory=Preprocess)


@dataclass(frozen=True)
class RecordedTaps:
    """In the place of `PoseData`: the taps of the recordings that `Recorded` names."""
