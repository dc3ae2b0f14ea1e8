"""What a training does with a batch: the losses of each network as named terms per example, and what is validated."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.dataset.factorial import OTHER_IMAGE, SWAPPED_IMAGE
from jaxunshear.errors import UserError
from jaxunshear.model import pose_head, posenet, unet, unshearnet
from jaxunshear.model.decoded import Decoded
from jaxunshear.model.layers import in_precision
from jaxunshear.model.parts import Net, Tree
from jaxunshear.settings import networks
from jaxunshear.settings.targets import Targets, true_values
from jaxunshear.settings.training import Training
from jaxunshear.storage import Json
from jaxunshear.training import losses

Batch = Json


@dataclass(frozen=True)
class Task:
    """What differs between the networks. Terms are losses per example (B,), by name."""

    kind: str
    net: Net  # the network's settings
    targets: Targets
    init: Callable[[Array], Tree]
    terms: Callable[[Tree, Batch, Array], tuple[dict[str, Array], Tree]]  # variables, batch, key -> terms, batch_stats
    weights: dict[str, float]
    validate: Callable[[Tree, Batch], dict[str, Array]]
    rank: str  # the validation term that the best model is chosen by
    slides: Targets = ()  # what z_s is taught of the slide


def unshear_task(
    net: networks.UnshearNet | networks.UNet,
    training: Training,
    teacher: Callable[[Array], Array] | None = None,
    targets: Targets = (),
    slides: Targets = (),
) -> Task:
    """Of an entangled or disentangled UnshearNet, or a U-Net; batches {"canonical", "sheared"} uint8 (B, S, S, 1) of {0, 255}.

    `teacher` is a trained PoseNet, images (B, S, S, 1) in [0, 1] -> outputs (B, K), needed for `pose_weight` alone;
    where labels teach (`label_weight`, `pose_target` "label") it takes the pose `targets`, the teacher's too, and their fields in the
    batches. A field {"weight"} (B,) weighs the examples. Of codes that are `apart`, `slides` are what z_s is taught, and need their fields;
    and where poses share slides partners come with the batches, {"other", "swapped"} uint8 as above, see `dataset.factorial`; where they
    don't, the pose code of a slide is to agree with its tap's.
    Raises UserError where the network cannot be built, or a crop does not fit.
    """
    _check_crops(net, training)
    watch = _watcher(training, teacher, targets)
    kind = "unet" if isinstance(net, networks.UNet) else "unshear"
    module: ModuleType = unet if kind == "unet" else unshearnet
    _checked(module.check, net)
    decoded = partial(_decoded, net, training)
    init, labelled = _head(net, targets) if training.label_weight else (partial(module.init, net), None)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        canonical, sheared = _unit(batch["canonical"]), _unit(batch["sheared"])
        found, batch_stats = decoded(variables, sheared, batch)
        image = jax.nn.sigmoid(found.canonical)
        named = {"supervised": losses.supervised(image, canonical)}
        if training.patch_weight:
            corners = losses.random_corners(key, len(image), training.crops, net.size, training.crop_px)
            named["patch"] = losses.patch(image, canonical, losses.coverage(corners, net.size, training.crop_px))
        if watch:
            named["pose"] = watch(image, canonical, batch)
        if labelled and found.z_p is not None:
            named["label"] = labelled(variables, found.z_p, batch)["label"]
        return weighed(named | _of_codes(found, sheared, batch, slides), batch), batch_stats

    def validate(variables: Tree, batch: Batch) -> dict[str, Array]:
        canonical, sheared = _unit(batch["canonical"]), _unit(batch["sheared"])
        images = in_precision(sheared, training.precision)  # as it will be put to use
        named = {}
        if isinstance(net, networks.UNet):
            image = unet.unshear(net, variables, images)
        else:
            z_p, z_s = unshearnet.encode(net, variables, images)
            again = None if z_s is None else unshearnet.decode_sheared(net, variables, z_p, z_s)
            found = Decoded(unshearnet.decode_canonical(net, variables, z_p), z_p, again, z_s=z_s)
            image, named = jax.nn.sigmoid(found.canonical), _of_codes(found, sheared, batch, slides)
            if labelled:
                named |= labelled(variables, z_p, batch)
        if watch:
            named["pose"] = watch(image, canonical, batch)
        return weighed({"supervised": losses.supervised(image, canonical)} | named, batch)

    return Task(kind, net, targets, init, terms, _weights(training), validate, "supervised", slides)


def _decoded(
    net: networks.UnshearNet | networks.UNet, training: Training, variables: Tree, sheared: Array, batch: Batch
) -> tuple[Decoded, Tree]:
    seen = partial(in_precision, precision=training.precision)
    if isinstance(net, networks.UNet):
        return unet.reconstruct(net, variables, seen(sheared))
    parted = net.disentangled and net.apart
    alike = batch.get(SWAPPED_IMAGE, batch["canonical"]) if parted and training.agreement_weight else None
    other = batch[OTHER_IMAGE] if parted and training.swap_weight else None
    partners = (None if images is None else seen(_unit(images)) for images in (alike, other))
    return unshearnet.reconstruct(net, variables, seen(sheared), *partners)


def _of_codes(found: Decoded, sheared: Array, batch: Batch, slides: Targets) -> dict[str, Array]:
    """What DS makes of codes, and what these should be, (B,) each."""
    named = {}
    if found.sheared is not None:
        named["reconstruction"] = losses.reconstruction(jax.nn.sigmoid(found.sheared), sheared)
    if found.exchanged is not None:
        named["swap"] = losses.reconstruction(jax.nn.sigmoid(found.exchanged), _unit(batch[SWAPPED_IMAGE]))
    if found.disagreement is not None:
        named["agreement"] = found.disagreement
    if slides and found.z_s is not None:
        named["slide"] = slide_term(found.z_s, batch, slides)
    return named


def posenet_task(net: networks.PoseNet, training: Training, targets: Targets) -> Task:
    """Of PoseNet; batches {"image"} uint8 (B, S, S, 1) and the fields of the `targets`, float32. Raises UserError without targets."""
    if not targets:
        raise UserError("targets: there is no pose to learn: name some, or record labels")
    weights = posenet.output_weights(targets)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        images = in_precision(_unit(batch["image"]), training.precision)
        outputs, batch_stats = posenet.predict_training(net, variables, images)
        return {"pose": losses.pose(outputs, posenet.pose_targets(batch, targets), weights)}, batch_stats

    def validate(variables: Tree, batch: Batch) -> dict[str, Array]:
        outputs = posenet.predict(net, variables, _unit(batch["image"]))
        loss = losses.pose(outputs, posenet.pose_targets(batch, targets), weights)
        return {"pose": loss} | pose_error_terms(outputs, batch, targets)

    _checked(posenet.check, net)
    init = partial(posenet.init, net, posenet.outputs_of(targets))
    return Task("posenet", net, targets, init, terms, {"pose": 1.0}, validate, "pose")


def _weights(training: Training) -> dict[str, float]:
    return {
        "supervised": 1.0,
        "patch": training.patch_weight,
        "pose": training.pose_weight,
        "label": training.label_weight,
        "reconstruction": training.reconstruction_weight,
        "swap": training.swap_weight,
        "agreement": training.agreement_weight,
        "slide": training.slide_weight,
    }


def _check_crops(net: networks.UnshearNet | networks.UNet, training: Training) -> None:
    if not 0 < training.crop_px <= net.size:
        raise UserError(f"crop_px: crops of {training.crop_px} px do not fit images of {net.size} px")
    if training.patch_weight and training.crops < 1:
        raise UserError(f"crops: {training.crops} of them leave no patch loss: use at least 1, or patch_weight 0")


def _watcher(
    training: Training, teacher: Callable[[Array], Array] | None, targets: Targets
) -> Callable[[Array, Array, Batch], Array] | None:
    """The loss by the pose that `teacher` reads, of image, canonical image and batch; None where it has no weight. Raises
    UserError."""
    if not training.pose_weight:
        return None
    if teacher is None:
        raise UserError("pose_weight: a PoseNet is needed to read the pose: train one first, or use pose_weight 0")
    if not targets:
        raise UserError("pose_weight: no pose targets are known: give them, or use pose_weight 0")
    return partial(watched, teacher, targets, training.pose_target)


def _head(
    net: networks.UnshearNet | networks.UNet, targets: Targets
) -> tuple[Callable[[Array], Tree], Callable[[Tree, Array, Batch], dict[str, Array]]]:
    """How a network with a head on the pose code begins, and the head's loss and errors. Raises UserError where it can
    have none."""
    if isinstance(net, networks.UNet):
        raise UserError("label_weight: a U-Net has no code to read the pose off: leave unet out, or use label_weight 0")
    if not targets:
        raise UserError("label_weight: no pose targets are known: give them, or use label_weight 0")
    return partial(_init_with_head, net, posenet.outputs_of(targets)), partial(_labelled, targets)


def watched(
    teacher: Callable[[Array], Array], targets: Targets, target: str, image: Array, canonical: Array, batch: Batch
) -> Array:
    """How far the pose that `teacher` reads off an image lies from the one it reads off the tap (B,): no label enters. With `target`
    "label", from the true one."""
    wanted = posenet.pose_targets(batch, targets) if target == "label" else teacher(canonical)
    return losses.pose(teacher(image), wanted, posenet.output_weights(targets))


def _init_with_head(net: networks.UnshearNet, outputs: int, key: Array) -> Tree:
    """Variables of the network, the very ones it has without a head, and the head's parameters beside them."""
    variables = unshearnet.init(net, key)
    head = pose_head.init(unshearnet.code_shape(net), outputs, jax.random.fold_in(key, 1))
    return variables | {"params": variables["params"] | {"head": head}}


def _labelled(targets: Targets, variables: Tree, code: Array, batch: Batch) -> dict[str, Array]:
    """PoseNet's loss of what the head reads off the pose code, and the errors in mm and deg, each (B,)."""
    outputs = pose_head.predict(variables["params"]["head"], code)
    loss = losses.pose(outputs, posenet.pose_targets(batch, targets), posenet.output_weights(targets))
    return {"label": loss} | pose_error_terms(outputs, batch, targets)


def pose_error_terms(outputs: Array, batch: Batch, targets: Targets) -> dict[str, Array]:
    """Absolute errors in mm and deg by target, each (B,)."""
    got, true = posenet.pose_from_outputs(outputs, targets), true_values(targets, batch)
    return {name: jnp.abs(_wrapped(got[name] - true[name], 360.0 if name.endswith("_deg") else None)) for name in got}


def slide_term(z_s: Array, batch: Batch, slides: Targets) -> Array:
    """How far the first numbers of z_s (B, ...) lie from the slide (B,)."""
    return losses.slide(z_s.reshape(z_s.shape[0], -1), 2 * posenet.pose_targets(batch, slides) - 1)


def weighed(named: dict[str, Array], batch: Batch) -> dict[str, Array]:
    """Terms (B,) times what each example counts: its weight, and nothing where its pins are not sure; where the batch says so."""
    for field in ("weight", "sure"):
        if field in batch:
            named = {name: term * batch[field] for name, term in named.items()}
    return named


def _unit(images: Array) -> Array:
    """uint8 {0, 255} -> float32 [0, 1]; floats are taken as they are."""
    return images.astype(jnp.float32) / 255.0 if jnp.issubdtype(images.dtype, jnp.integer) else images


def _wrapped(difference: Array, turn: float | None) -> Array:
    return difference if turn is None else (difference + turn / 2) % turn - turn / 2


def _checked(check: Callable[[Net], None], net: Net) -> None:
    try:
        check(net)
    except ValueError as error:
        raise UserError(str(error)) from error
