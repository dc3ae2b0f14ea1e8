"""How networks are trained. Imports no JAX."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Training:
    """Losses, optimiser and schedule of one network (paper section 3.3, appendix B)."""

    epochs: float = 6.0
    batch: int = 16
    optimiser: str = (
        "adam"  # the paper's; or "muon", which takes the same learning rates and gets further with each image
    )
    learning_rate: float = 1e-3
    schedule: str = "cosine"  # "cosine": to zero over the run; "steps": factors of `drops`
    drops: tuple[tuple[float, float], ...] = ()  # (epoch, factor on the first learning rate)
    beta1: float = 0.5  # of Adam, which with "muon" trains the first and last layers, biases and normalisation
    beta2: float = 0.999
    l1: float = 0.0  # of |w| and w^2 of convolution and dense kernels, as `kernels` says, added up over all of them
    l2: float = 0.0
    kernels: str = "sum"  # over a kernel's weights, as Keras does; or their "mean", which no kernel's size changes
    patch_weight: float = 0.1  # lambda: L2 to L1-patch loss is 10:1
    crops: int = 100
    crop_px: int = 20
    reconstruction_weight: float = 1.0
    # of codes that do not leak, over pins: that the pose code of one slide with the shear code of another draws the contact of just that
    # pose and slide, where poses share slides (`paired.poses_a_slide`); that equal poses, a slide's and its tap's too, and equal slides
    # have equal codes
    swap_weight: float = 0.0
    agreement_weight: float = 0.0
    # of fewer pairs: the share of the simulated training poses, drawn by seed, whose slides have their tap, the other slides being left
    # out; over pins, that taps without a slide, those that PoseNet learns from, come out as they went in; that two slides to one pose,
    # whether they have a tap or not, are unsheared alike
    paired_share: float = 1.0
    tap_weight: float = 0.0
    alike_weight: float = 0.0
    pose_weight: float = 0.0  # of what a PoseNet reads off the unsheared image, against `pose_target`
    pose_target: str = "tap"  # what the same PoseNet reads off the tap; or "label", the true pose
    label_weight: float = 0.0  # of the pose that a head reads off z_p, against the true one; 0 builds no head
    precision: str = "float32"  # of the convolutions; or "bfloat16"
    averaging: float = 0.99  # decay of the exponential moving average of the weights; 0 switches it off
    shift: float = 0.015  # random image shifts, largest, as a fraction of the image size (the paper: 1-2 %)
    start: str = ""  # weights to go on from: released ones by name, or a run's folder; none: fresh ones
    validate_every: int = 100  # steps; also when a checkpoint is written
    validation_images: int = 256  # at most, the first of the validation split


def exchanged(training: Training) -> bool:
    """Whether a network that unshears learns from exchanged codes."""
    return training.swap_weight > 0 or training.agreement_weight > 0


def labelled(training: Training) -> bool:
    """Whether a network that unshears is given true poses."""
    return training.label_weight > 0 or (training.pose_weight > 0 and training.pose_target == "label")
