"""Settings of a training: losses, optimiser and schedule."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from jaxunshear.config.losses import SUPERVISION, LossWeights
from jaxunshear.config.types import (
    Bound,
    Count,
    Fraction,
    NotNegative,
    Positive,
    Problem,
    Share,
    between,
)

PairCount = Annotated[int, Bound(lambda pairs: pairs >= 0, "must not be below zero")]
Drops = Annotated[
    tuple[tuple[float, float], ...],
    Bound(
        lambda drops: all(epoch > 0 and 0 < factor <= 1 for epoch, factor in drops),
        "are pairs epoch:factor, the epoch above 0, the factor above 0 and at most 1",
    ),
]


@dataclass(frozen=True)
class Training:
    """Losses, optimiser and schedule of one network (paper section 3.3, appendix B)."""

    epochs: Positive = 6.0  # passes through the training examples
    # steps at least: a small set is passed through more often
    min_steps: Count = 1
    batch: Count = 16  # examples of a step
    # the optimiser: "adam", the paper's; or "muon", which takes the same learning rates and gets
    # further with each image
    optimiser: Literal["adam", "muon"] = "adam"
    learning_rate: Share = 1e-3  # learning rate at the start
    # schedule in steps: epochs, and factors on the first learning rate from there on; without any
    # it falls to zero over the run, as a cosine
    drops: Drops = ()
    # decay of Adam's first moment; with "muon" Adam trains the first and last layers, biases and
    # normalisation
    beta1: Fraction = 0.5
    l1: NotNegative = 0.0  # weight of |w|, added up over all convolution and dense kernels
    l2: NotNegative = 0.0  # weight of w^2, added up over all convolution and dense kernels
    # how l1 and l2 reduce a kernel: "sum" over its weights, as Keras does; "mean", which does not
    # depend on its size
    kernels: Literal["sum", "mean"] = "sum"
    # weights of all losses that are computed, by their names in config/losses.py; the defaults are
    # the paper's, whose lambda 0.1 gives "L2 and L1 patch loss in the ratio 10:1"
    losses: Mapping[str, float] = LossWeights(
        {"supervised": 1.0, "patch": 0.1, "reconstruction": 1.0}
    )
    crops: Count = 100  # random crops of an image, of the patch loss
    crop_px: Count = 20  # side of a crop, px
    # over pins: share of the simulated training poses, drawn by seed, whose slides have their tap;
    # other slides are left out
    paired_share: Share = 1.0
    # over recorded pins: number of training pairs below which batches are also turned about the
    # sensor's axis or mirrored: half of them in the smallest sets, fewer towards this number;
    # simulated slides are not turned
    rotated_below: PairCount = 0
    # decay of the exponential moving average of the weights; 0 switches it off
    ema_decay: Fraction = 0.99
    # largest random shift of images, as a fraction of their size (the paper: 1-2 %)
    shift: Annotated[float, between(0, 0.25)] = 0.015
    # weights to start from: the name of released ones, or a run's folder; empty: random ones
    start: str = ""
    validate_every: Count = 100  # steps from one validation, and checkpoint, to the next
    validation_images: Count = 256  # examples of a validation at most: the first of that split

    def __post_init__(self) -> None:
        if isinstance(self.losses, Mapping):  # else `check_types` reports it
            object.__setattr__(self, "losses", LossWeights(self.losses))

    def find_problems(self) -> Iterator[Problem]:
        epochs = [epoch for epoch, _ in self.drops]
        if epochs != sorted(set(epochs)):
            yield "drops", "must be in the order of their epochs"
        if not self.losses:
            yield "losses", "name at least one, as supervised:1"
        for name, weight in self.losses.items():
            if not weight > 0:
                yield f"losses.{name}", "must not be below zero; 0 leaves the loss out"


POSENET_TRAINING = Training(losses={"pose": 1.0})


def drop_pair_losses(training: Training, **losses: float) -> Training:
    """Replace the losses, and set what only losses of pairs read to its defaults."""
    return replace(
        training,
        losses=losses,
        crops=Training.crops,
        crop_px=Training.crop_px,
        paired_share=Training.paired_share,
        rotated_below=Training.rotated_below,
    )


def uses_teacher(training: Training) -> bool:
    """Return whether a PoseNet supervises the network that unshears."""
    return any(name in training.losses for name in SUPERVISION)
