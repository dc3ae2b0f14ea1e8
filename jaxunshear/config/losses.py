"""The losses that a training can name, and what each of them needs.

    Training(losses={"supervised": 1.0, "patch": 0.1, "reconstruction": 1.0})

A training computes the losses that it names, and no other. A new loss is one function and one entry
of LOSSES, or one function with `@register_loss` in an experiment file:

    @register_loss("smooth", modalities=("images",))
    def compute_smooth_loss(inputs):  # see training/losses.py
        return jnp.mean(jnp.square(jnp.diff(inputs.unsheared, axis=1)), (1, 2, 3))
"""

import pkgutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

from jaxunshear.config.types import claim_name
from jaxunshear.errors import UserError

Role = Literal["unshears", "reads poses", "renders"]  # what a network of a loss does
InputKind = Literal["images", "pins"]
Requirement = Literal["codes", "shared slides", "two slides", "simulated", "still pins"]

SUPERVISION = ("pose_label", "pose_tap")  # losses that a teacher computes
EXCHANGE = ("counterfactual", "code_agreement")  # losses that compare or swap codes of two slides


class LossWeights(dict[str, float]):
    """Immutable weights of losses by name, without those that are 0."""

    def __init__(self, weights: Mapping[str, float] | Iterable[tuple[str, float]] = ()) -> None:
        super().__init__(sorted((name, weight) for name, weight in dict(weights).items() if weight))

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError("weights of losses do not change: make others with {**weights, name: 1.0}")

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self.items()))

    def __reduce__(self) -> tuple[type["LossWeights"], tuple[dict[str, float]]]:
        return type(self), (dict(self),)


@dataclass(frozen=True)
class LossSpec:
    """What a loss is for, and what it needs."""

    name: str
    compute: Callable[..., Any] | None = None  # None: compute_<name>_term of training/losses.py
    role: Role = "unshears"
    modalities: tuple[InputKind, ...] = ("images", "pins")
    # of `Reconstruction`; a network that does not compute them leaves the loss out
    parts: tuple[str, ...] = ()
    # of a batch, in addition to both sides of the pairs: "labels" of poses, "slide_labels", "other"
    # and "swapped" partners if poses share slides, or any field of the data set by its name
    fields: tuple[str, ...] = ()
    requires: tuple[Requirement, ...] = ()
    is_validated: bool = True  # also computed on validation examples

    def load(self) -> Callable[..., Any]:
        place = f"jaxunshear.training.losses:compute_{self.name}_term"
        return self.compute or pkgutil.resolve_name(place)


IMAGES: tuple[InputKind, ...] = ("images",)
PINS: tuple[InputKind, ...] = ("pins",)
SIMULATED: tuple[Requirement, ...] = ("simulated", "still pins")
# The order is that in which the terms are added: another one would change the bits of their sum.
LOSSES: dict[str, LossSpec] = {
    spec.name: spec
    for spec in (
        LossSpec("supervised"),
        LossSpec("patch", modalities=IMAGES, is_validated=False),
        LossSpec("pose_label", fields=("labels",)),
        LossSpec("pose_tap"),
        LossSpec("reconstruction", parts=("sheared",)),
        LossSpec(
            "counterfactual",
            parts=("counterfactual",),
            fields=("other", "swapped"),
            requires=("codes", "shared slides"),
        ),
        LossSpec(
            "code_agreement", parts=("disagreement",), fields=("swapped",), requires=("codes",)
        ),
        LossSpec("slide", parts=("z_s",), fields=("slide_labels",), requires=("codes",)),
        LossSpec("tap_identity", modalities=PINS, requires=SIMULATED, is_validated=False),
        LossSpec(
            "consistency",
            modalities=PINS,
            requires=(*SIMULATED, "two slides"),
            is_validated=False,
        ),
        LossSpec("pose", role="reads poses"),
        LossSpec("rendered_pose", role="reads poses", modalities=PINS, is_validated=False),
        LossSpec("pins", role="renders", modalities=PINS),
    )
}


def register_loss(name: str, **needs: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function as a loss that a training can name; `needs` are fields of `LossSpec`.

    The function takes the inputs of its role, `PairInputs` or `PoseInputs` of training/losses.py,
    and returns a loss per example (B,). Raises UserError if another loss has this name.
    """

    def register(compute: Callable[..., Any]) -> Callable[..., Any]:
        claim_name("loss", name, LOSSES, compute.__code__.co_filename)
        LOSSES[name] = LossSpec(name, compute, **needs)
        return compute

    return register


def get_loss(name: str) -> LossSpec:
    if name not in LOSSES:
        raise UserError(
            f"loss '{name}' is unknown: use one of {', '.join(LOSSES)}, "
            "or name the experiment file that registers it"
        )
    return LOSSES[name]
