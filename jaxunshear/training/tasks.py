"""What a training does with a batch: the losses of each network as named terms per example, and what is validated."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.angles import wrap_degrees
from jaxunshear.config import networks
from jaxunshear.config.targets import Targets, read_true_values
from jaxunshear.config.training import Training
from jaxunshear.data.factorial import OTHER_IMAGE, SWAPPED_IMAGE
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models import posenet, unet, unshearnet
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.models.weights import Net, Tree
from jaxunshear.training import losses

Batch = Json


@dataclass(frozen=True)
class Task:
    """What differs between the networks. Terms are losses per example (B,), by name."""

    kind: str
    net: Net  # the network's settings
    targets: Targets
    init: Callable[[Array], Tree]
    terms: Callable[
        [Tree, Batch, Array], tuple[dict[str, Array], Tree]
    ]  # variables, batch, key -> terms, batch_stats
    weights: dict[str, float]
    validate: Callable[[Tree, Batch], dict[str, Array]]
    rank: str  # the validation term that the best model is chosen by
    slide_targets: Targets = ()  # what z_s is taught of the slide


def make_unshear_task(
    net: networks.UnshearNet | networks.UNet,
    training: Training,
    teacher: Callable[[Array], Array] | None = None,
    targets: Targets = (),
    slides: Targets = (),
) -> Task:
    """Of an entangled or disentangled UnshearNet, or a U-Net; batches {"canonical", "sheared"} uint8 (B, S, S, 1) of {0, 255}.

    `teacher` is a trained PoseNet, images (B, S, S, 1) in [0, 1] -> outputs (B, K), needed for `pose_weight` alone;
    where labels teach (`pose_target` "label") it takes the pose `targets`, the teacher's too, and their fields in the
    batches. A field {"weight"} (B,) weighs the examples. Of codes that are `apart`, `slides` are what z_s is taught, and need their fields;
    and where poses share slides partners come with the batches, {"other", "swapped"} uint8 as above, see `dataset.factorial`; where they
    don't, the pose code of a slide is to agree with its tap's.
    Raises UserError where the network cannot be built, or a crop does not fit.
    """
    _check_crops(net, training)
    watch = make_pose_supervision(training, teacher, targets, losses.compute_pose_loss)
    kind = "unet" if isinstance(net, networks.UNet) else "unshear"
    module: ModuleType = unet if kind == "unet" else unshearnet
    module.check_net(net)
    decoded = partial(_decode, net, training)
    of_codes = partial(
        compute_code_terms, fields=("sheared", SWAPPED_IMAGE), distance=_off_image, slides=slides
    )
    init = partial(module.init, net)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        batch = _as_floats(batch)
        canonical = batch["canonical"]
        found, batch_stats = decoded(variables, batch)
        image = jax.nn.sigmoid(found.canonical)
        named = {"supervised": supervise_both_slides(found, canonical, _off_image)}
        if training.patch_weight:
            corners = losses.sample_corners(
                key, len(image), training.crops, net.size, training.crop_px
            )
            named["patch"] = losses.compute_patch_loss(
                image, canonical, losses.count_crop_coverage(corners, net.size, training.crop_px)
            )
        if watch:
            named["pose"] = watch(image, canonical, batch)
        return weight_terms(named | of_codes(found, batch=batch), batch), batch_stats

    def validate(variables: Tree, batch: Batch) -> dict[str, Array]:
        batch = _as_floats(batch)
        canonical = batch["canonical"]
        images = batch["sheared"]
        named = {}
        if isinstance(net, networks.UNet):
            image = unet.unshear(net, variables, images)
        else:
            z_p, z_s = unshearnet.encode(net, variables, images)
            again = None if z_s is None else unshearnet.decode_sheared(net, variables, z_p, z_s)
            found = Reconstruction(
                unshearnet.decode_canonical(net, variables, z_p), z_p, again, z_s=z_s
            )
            image, named = jax.nn.sigmoid(found.canonical), of_codes(found, batch=batch)
        if watch:
            named["pose"] = watch(image, canonical, batch)
        return weight_terms(
            {"supervised": losses.compute_supervised_loss(image, canonical)} | named, batch
        )

    return Task(
        kind, net, targets, init, terms, list_loss_weights(training), validate, "supervised", slides
    )


def _decode(
    net: networks.UnshearNet | networks.UNet, training: Training, variables: Tree, batch: Batch
) -> tuple[Reconstruction, Tree]:
    if isinstance(net, networks.UNet):
        return unet.reconstruct(net, variables, batch["sheared"])
    parted = net.disentangled and net.apart
    alike = (
        batch.get(SWAPPED_IMAGE, batch["canonical"])
        if parted and training.agreement_weight
        else None
    )
    other = batch[OTHER_IMAGE] if parted and training.swap_weight else None
    return unshearnet.reconstruct(net, variables, batch["sheared"], alike, other)


def supervise_both_slides(
    found: Reconstruction, canonical: Array, distance: Callable[[Array, Array], Array]
) -> Array:
    """Return L_sup (B,) of the slide, averaged with its partner's where codes of one pose should agree.

    `distance` is the distance of what DC reconstructs from the tap (B,).
    """
    own = distance(found.canonical, canonical)
    return own if found.same_pose is None else 0.5 * (own + distance(found.same_pose, canonical))


def compute_code_terms(
    found: Reconstruction,
    fields: tuple[str, str],
    distance: Callable[[Array, Array], Array],
    batch: Batch,
    slides: Targets,
) -> dict[str, Array]:
    """What DS makes of codes, and what these should be, (B,) each. `fields` of a batch: the slide, and what exchanged codes should draw;
    `distance`: how far what DS draws lies from such a field (B,)."""
    named = {}
    if found.sheared is not None:
        named["reconstruction"] = distance(found.sheared, batch[fields[0]])
    if found.counterfactual is not None:
        named["swap"] = distance(found.counterfactual, batch[fields[1]])
    if found.disagreement is not None:
        named["agreement"] = found.disagreement
    if slides and found.z_s is not None:
        wanted = 2 * posenet.scale_poses(batch, slides) - 1
        named["slide"] = losses.compute_slide_loss(
            found.z_s.reshape(found.z_s.shape[0], -1), wanted
        )
    return named


def _off_image(logits: Array, wanted: Array) -> Array:
    return losses.compute_reconstruction_loss(jax.nn.sigmoid(logits), wanted)


def make_posenet_task(net: networks.PoseNet, training: Training, targets: Targets) -> Task:
    """Of PoseNet; batches {"image"} uint8 (B, S, S, 1) and the fields of the `targets`, float32. Raises UserError without targets."""
    if not targets:
        raise UserError("targets: there is no pose to learn: name some, or record labels")
    weights = posenet.list_output_weights(targets)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        images = _unit(batch["image"])
        outputs, batch_stats = posenet.predict_training(net, variables, images)
        return {
            "pose": losses.compute_pose_loss(outputs, posenet.scale_poses(batch, targets), weights)
        }, batch_stats

    def validate(variables: Tree, batch: Batch) -> dict[str, Array]:
        outputs = posenet.predict(net, variables, _unit(batch["image"]))
        loss = losses.compute_pose_loss(outputs, posenet.scale_poses(batch, targets), weights)
        return {"pose": loss} | compute_pose_error_terms(outputs, batch, targets)

    posenet.check_net(net)
    init = partial(posenet.init, net, posenet.count_outputs(targets))
    return Task("posenet", net, targets, init, terms, {"pose": 1.0}, validate, "pose")


def list_loss_weights(training: Training) -> dict[str, float]:
    """Of the terms of all networks that unshear."""
    return {
        "supervised": 1.0,
        "patch": training.patch_weight,
        "pose": training.pose_weight,
        "reconstruction": training.reconstruction_weight,
        "swap": training.swap_weight,
        "agreement": training.agreement_weight,
        "slide": training.slide_weight,
        "tap": training.tap_weight,
        "alike": training.alike_weight,
    }


def _check_crops(net: networks.UnshearNet | networks.UNet, training: Training) -> None:
    if not 0 < training.crop_px <= net.size:
        raise UserError(
            f"crop_px: crops of {training.crop_px} px do not fit images of {net.size} px"
        )
    if training.patch_weight and training.crops < 1:
        raise UserError(
            f"crops: {training.crops} of them leave no patch loss: use at least 1, or patch_weight 0"
        )


def make_pose_supervision(
    training: Training,
    teacher: Callable[[Array], Array] | None,
    targets: Targets,
    loss: Callable[[Array, Array, tuple[float, ...]], Array],
) -> Callable[[Array, Array, Batch], Array] | None:
    """How far the pose that `teacher` reads off unsheared images or pins lies from the one it reads off the taps (B,), as a function of
    both and the batch; with `pose_target` "label", from the true one. None where it has no weight. Raises UserError."""
    if not training.pose_weight:
        return None
    if teacher is None:
        raise UserError(
            "pose_weight: a PoseNet is needed to read the pose: train one first, or use pose_weight 0"
        )
    if not targets:
        raise UserError("pose_weight: no pose targets are known: give them, or use pose_weight 0")
    weights = posenet.list_output_weights(targets)

    def compute_pose_supervision(unsheared: Array, canonical: Array, batch: Batch) -> Array:
        wanted = (
            posenet.scale_poses(batch, targets)
            if training.pose_target == "label"
            else teacher(canonical)
        )
        return loss(teacher(unsheared), wanted, weights)

    return compute_pose_supervision


def compute_pose_error_terms(outputs: Array, batch: Batch, targets: Targets) -> dict[str, Array]:
    """Absolute errors in mm and deg by target, each (B,)."""
    got, true = posenet.unscale_outputs(outputs, targets), read_true_values(targets, batch)
    apart = {name: true[name] - got[name] for name in got}
    return {
        name: jnp.abs(wrap_degrees(off) if name.endswith("_deg") else off)
        for name, off in apart.items()
    }


def weight_terms(named: dict[str, Array], batch: Batch) -> dict[str, Array]:
    """Terms (B,) times what each example counts: its weight, and nothing where its pins are not sure; where the batch says so."""
    for field in ("weight", "sure"):
        if field in batch:
            named = {name: term * batch[field] for name, term in named.items()}
    return named


def _as_floats(batch: Batch) -> Batch:
    """With all images as `_unit` has them."""
    images = ("canonical", "sheared", OTHER_IMAGE, SWAPPED_IMAGE)
    return batch | {name: _unit(batch[name]) for name in images if name in batch}


def _unit(images: Array) -> Array:
    """uint8 {0, 255} -> float32 [0, 1]; floats are taken as they are."""
    return (
        images.astype(jnp.float32) / 255.0 if jnp.issubdtype(images.dtype, jnp.integer) else images
    )
