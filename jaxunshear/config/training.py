"""How networks are trained."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from jaxunshear.config.types import Rule

WEIGHT_FIELDS = (  # of losses and of penalties
    *("patch_weight", "reconstruction_weight", "swap_weight", "agreement_weight", "slide_weight"),
    *("tap_weight", "alike_weight", "pose_weight", "l1", "l2"),
)


@dataclass(frozen=True)
class Training:
    """Losses, optimiser and schedule of one network (paper section 3.3, appendix B)."""

    epochs: float = 6.0  # times through the training examples
    batch: int = 16  # examples a step
    # "adam": the paper's; "muon" takes the same learning rates and gets further with each image
    optimiser: Literal["adam", "muon"] = "adam"
    learning_rate: float = 1e-3  # at the start
    # "cosine": to zero over the run; "steps": factors of `drops`
    schedule: Literal["cosine", "steps"] = "cosine"
    drops: tuple[tuple[float, float], ...] = ()  # (epoch, factor on the first learning rate)
    # of Adam, which with "muon" trains the first and last layers, biases and normalisation
    beta1: float = 0.5
    beta2: float = 0.999  # of Adam
    l1: float = 0.0  # weight of |w| of convolution and dense kernels, as `kernels` says, added up over all of them
    l2: float = 0.0  # weight of w^2, likewise
    # "sum": over a kernel's weights, as Keras does; "mean": which no kernel's size changes
    kernels: Literal["sum", "mean"] = "sum"
    patch_weight: float = 0.1  # lambda: L2 to L1-patch loss is 10:1
    crops: int = 100  # random crops an image, of the patch loss
    crop_px: int = 20  # their side
    reconstruction_weight: float = 1.0  # of L_rec: DS draws the sheared image again
    # the pose code of one slide with the shear code of another draws the contact of just that pose and slide, where poses share slides
    # (`paired.poses_a_slide`); this and the next two over images of codes that are apart
    swap_weight: float = 0.0
    # equal poses have equal pose codes, those of two slides, or of a slide and its tap: the squared difference in every direction of
    # the code over its variance, and DC reconstructs the tap from both
    agreement_weight: float = 0.0
    # the numbers of z_s are the slide in the sensor's frame, shifts before turns, as many as it has room for, each over half of its range
    slide_weight: float = 0.0
    # over pins: share of the simulated training poses, drawn by seed, whose slides have their tap; other slides are left out
    paired_share: float = 1.0
    tap_weight: float = 0.0  # over pins: taps without a slide, those that PoseNet learns from, come out as they went in
    alike_weight: float = 0.0  # over pins: two slides to one pose, whether they have a tap or not, are unsheared alike
    # of what a PoseNet reads off the unsheared image, against `pose_target`
    pose_weight: float = 0.0
    # what the same PoseNet reads off the tap; or "label", the true pose
    pose_target: Literal["tap", "label"] = "tap"
    # decay of the exponential moving average of the weights; 0 switches it off
    averaging: float = 0.99
    # random image shifts, largest, as a fraction of the image size (the paper: 1-2 %)
    shift: float = 0.015
    # weights to go on from: released ones by name, or a run's folder; none: fresh ones
    start: str = ""
    validate_every: int = 100  # steps; also when a checkpoint is written
    validation_images: int = 256  # at most, the first of the validation split

    def rules(self) -> Iterator[Rule]:
        yield self.epochs > 0, "epochs", "must be above zero"
        for field in ("batch", "validate_every", "validation_images"):
            yield getattr(self, field) >= 1, field, "must be at least 1"
        yield 0 < self.learning_rate <= 1, "learning_rate", "use a number above 0, at most 1"
        yield (
            not self.drops or self.schedule == "steps",
            "drops",
            "have no effect with this schedule: use schedule 'steps'",
        )
        yield (
            all(epoch > 0 and 0 < factor <= 1 for epoch, factor in self.drops),
            "drops",
            "are pairs epoch:factor, the epoch above 0, the factor above 0 and at most 1",
        )
        epochs = [epoch for epoch, _ in self.drops]
        yield epochs == sorted(set(epochs)), "drops", "must be in the order of their epochs"
        for field in ("beta1", "beta2", "averaging"):
            yield 0 <= getattr(self, field) < 1, field, "use 0 up to, but not, 1"
        for field in WEIGHT_FIELDS:
            yield getattr(self, field) >= 0, field, "must not be below zero"
        yield 0 < self.paired_share <= 1, "paired_share", "use a share above 0, at most 1"
        yield 0 <= self.shift <= 0.25, "shift", "use a fraction of the image, 0 to 0.25"
        yield (
            self.crops >= 1,
            "crops",
            "must be at least 1; patch_weight 0 switches the patch loss off",
        )
        yield self.crop_px >= 1, "crop_px", "must be at least 1"


def uses_code_exchange(training: Training) -> bool:
    """Whether a network that unshears learns from exchanged codes."""
    return training.swap_weight > 0 or training.agreement_weight > 0


def uses_pose_labels(training: Training) -> bool:
    """Whether a network that unshears is given true poses."""
    return training.pose_weight > 0 and training.pose_target == "label"
