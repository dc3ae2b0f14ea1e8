"""Trainings at their extremes: settings, images and labels that risk infinite numbers.

Most are steps without the loop (`network_steps.py`), some a full training as a user would run it.
Where images are spoilt, every second batch is: a network that has only ever seen one constant
learns nothing that could break.
"""

import itertools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from jaxunshear.config.networks import ENTANGLED, PoseNet, UNet, UnshearNet
from jaxunshear.config.training import Training
from jaxunshear.training import checkpoint
from jaxunshear.training.trainer import TrainingData
from jaxunshear.training.trainer import train as train_network
from verification.network_images import (
    KINDS,
    Batch,
    convert_to_floats,
    corrupt_images,
    insert_nan,
    make_pairs,
    make_poses,
)
from verification.network_steps import (
    SAVED_EVERY,
    STEPS,
    Net,
    build_programs,
    describe_training,
    get_images,
    make_task,
    run_steps,
)
from verification.stability_networks import (
    FINITE,
    REFUSED,
    SAYS_WHERE,
    STOPPED,
    CaseOutput,
    NetworkCase,
)

NET = UnshearNet(size=64, widths=(6, 8, 8), pose_channels=8, shear_channels=8)
SHALLOW = UnshearNet(size=32, widths=(4, 6), pose_channels=8, shear_channels=8)  # quick to compile
UNET = UNet(size=32, widths=(4, 6))
POSENET = PoseNet(size=64, widths=(4, 4, 6, 6, 8), hidden=16)
TRAINING = Training(epochs=STEPS, batch=4, crops=20, crop_px=8, validate_every=SAVED_EVERY)
PAPER_NET = UnshearNet(size=256, widths=(32, 64, 64, 64, 64), pose_channels=64, shear_channels=64)
PAPER_POSENET = PoseNet(size=256)
PAPER = Training(learning_rate=1e-4, l1=1e-3, l2=1e-3, kernels="mean", ema_decay=0.0)
DECAYS = (1e-3, 1e3)
RATES = (1e-8, 1e-4, 1e-1, 1.0, 10.0)
PATCH_WEIGHTS = (0.0, 1e-2, 1.0, 1e2, 1e4)
# steps before what breaks a training: more than to its first checkpoint, fewer than to its second
BROKEN_FROM = 6
# the step whose batch is validated and used: odd, so spoilt where every second one is
VALIDATION = -1
KEPT = f"the checkpoint of step {SAVED_EVERY} is kept"
REMEDY = "the data, then run the same command"
Change = Callable[[int, Batch], Batch]  # changes the float batch after so many steps


def list_training_cases() -> Iterator[NetworkCase]:
    """List all cases of trainings; names are unique and begin with "network"."""
    yield from _list_settings()
    yield from _list_starts()
    for net in (SHALLOW, POSENET):
        yield from _list_decays(net)
    for net in (NET, POSENET):
        yield from _list_rates(net)
        yield from _list_images(net)
        yield from _list_batches(net)
    for trained in (SHALLOW, POSENET, UNET):
        yield from _list_trainings(trained)


def make_steps_case(
    name: str,
    net: Net,
    training: Training = TRAINING,
    change: Change = lambda step, batch: batch,
    expects: tuple[str, ...] = (FINITE,),
    words: tuple[str, ...] = SAYS_WHERE,
    steps: int = STEPS,
) -> NetworkCase:
    def make(step: int) -> Batch:
        count = training.batch if step != VALIDATION else 4
        return change(step, corrupt_images(convert_to_floats, make_batch(net, step, count)))

    run = partial(run_steps, net, training, make, steps=steps)
    return NetworkCase(f"network {get_kind(net)}, {name}", run, expects, words)


def get_kind(net: Net) -> str:
    return type(net).__name__


def make_batch(net: Net, step: int, count: int) -> Batch:
    return (make_poses if isinstance(net, PoseNet) else make_pairs)(step % 1000, count, net.size)


def change_every_second(kind: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda step, batch: corrupt_images(kind, batch) if step % 2 else batch


def _list_settings() -> Iterator[NetworkCase]:
    for weight in PATCH_WEIGHTS:
        training = replace(TRAINING, losses={**TRAINING.losses, "patch": weight})
        yield make_steps_case(f"patch weight {weight:g}", NET if weight else SHALLOW, training)
    for pose, shear in ((64, 64), (128, 0)):
        net = replace(SHALLOW, pose_channels=pose, shear_channels=shear)
        yield make_steps_case(f"codes {pose}:{shear}", net)
    refused = partial(make_steps_case, expects=(REFUSED,))
    for pose, shear, field in ((0, 128, "pose_channels"), (128, -1, "shear_channels")):
        net = replace(SHALLOW, pose_channels=pose, shear_channels=shear)
        yield refused(f"codes {pose}:{shear}", net, words=(field,))
    for field, value in (("crops", 0), ("crop_px", 65)):
        training = replace(TRAINING, **{field: value})  # type: ignore[arg-type]
        yield refused(f"{field} that cannot be", SHALLOW, training, words=(field,))
    yield make_steps_case(ENTANGLED, replace(SHALLOW, disentangled=False))
    name, training = "of the usual 128 px and widths", replace(TRAINING, batch=2)
    yield make_steps_case(name, UnshearNet(), training, steps=SAVED_EVERY)


def _list_decays(net: Net) -> Iterator[NetworkCase]:
    """List cases by weights on kernels: the paper's, and such as leave nothing else to learn."""
    for weight in DECAYS:
        yield make_steps_case(f"l1 {weight:g}", net, replace(TRAINING, l1=weight))
        yield make_steps_case(f"l2 {weight:g}", net, replace(TRAINING, l2=weight))


def _list_starts() -> Iterator[NetworkCase]:
    """List first steps of experiments/paper.py, by what its weights on kernels can mean."""
    nets: tuple[Net, ...] = (PAPER_NET, PAPER_POSENET)
    sums: tuple[Literal["sum", "mean"], ...] = ("sum", "mean")
    for net, kernels in itertools.product(nets, sums):
        name = f"the paper's start, l1 and l2 per {kernels}"
        training = replace(PAPER, batch=2, kernels=kernels)
        yield make_steps_case(name, net, training, steps=SAVED_EVERY)


def _list_rates(net: Net) -> Iterator[NetworkCase]:
    for rate in RATES:
        name, training = f"learning rate {rate:g}", replace(TRAINING, learning_rate=rate)
        yield make_steps_case(name, net, training, expects=(FINITE, STOPPED))
    # finite terms, and an update that throws the weights away, in the step before a checkpoint
    training = replace(TRAINING, drops=((STEPS - 1, math.inf),))
    words = (*SAYS_WHERE, "params", f"step {STEPS}", f"batch {STEPS - 1}", KEPT)
    yield make_steps_case("learning rate inf", net, training, expects=(STOPPED,), words=words)


def _list_images(net: Net) -> Iterator[NetworkCase]:
    for name, kind in KINDS.items():
        yield make_steps_case(f"images {name}", net, change=change_every_second(kind))
    stopped = partial(make_steps_case, net=net, expects=(STOPPED,))
    words = _list_words("of examples 1;", REMEDY)
    yield stopped("images with a NaN", change=_put_nan, words=words)
    words = _list_words("to 1e+25;", "learning_rate")
    yield stopped("images of 1e25", change=_scale_up, words=words)
    if isinstance(net, PoseNet):
        words = _list_words("pose not finite", "in pose of examples 0, 1, 2, 3;", REMEDY)
        yield stopped("infinite labels", change=_make_labels_infinite, words=words)


def _list_words(*more: str) -> tuple[str, ...]:
    """List what the message of a training that breaks after `BROKEN_FROM` steps must hold."""
    return (*SAYS_WHERE, f"step {BROKEN_FROM + 1}", f"batch {BROKEN_FROM}", KEPT, *more)


def _put_nan(step: int, batch: Batch) -> Batch:
    return corrupt_images(insert_nan, batch) if step == BROKEN_FROM else batch


def _scale_up(step: int, batch: Batch) -> Batch:
    """Scale images up until their variance overflows."""
    if step != BROKEN_FROM:
        return batch
    return corrupt_images(lambda images: images * np.float32(1e25), batch)


def _make_labels_infinite(step: int, batch: Batch) -> Batch:
    return batch | {"pose": np.full_like(batch["pose"], np.inf)} if step == BROKEN_FROM else batch


def _list_batches(net: Net) -> Iterator[NetworkCase]:
    single, alone = replace(TRAINING, batch=1), net if isinstance(net, PoseNet) else SHALLOW
    yield make_steps_case("batches of one image", alone, single)
    # so small that a channel of the last convolution is one number, which normalisation makes zero
    narrow = replace(alone, size=16 if isinstance(net, PoseNet) else 4)
    name = "batches of one image, codes of one pixel"
    yield make_steps_case(name, narrow, replace(single, crop_px=4))
    one = corrupt_images(convert_to_floats, make_batch(net, 0, 1))

    def one_pose(step: int, batch: Batch) -> Batch:
        return {name: np.repeat(values, len(batch[name]), 0) for name, values in one.items()}

    yield make_steps_case("one pose only", net, change=one_pose)


def _list_trainings(net: Net) -> Iterator[NetworkCase]:
    """List trainings through the loop: as usual, and one that diverges later."""
    diverging = replace(TRAINING, drops=((float(BROKEN_FROM), 1e30),))
    words = (*SAYS_WHERE, KEPT, "whose numbers are", "learning_rate")
    trainings = [("a training", TRAINING, FINITE), ("a diverging training", diverging, STOPPED)]
    for name, training, expects in trainings[: 1 if isinstance(net, UNet) else 2]:
        run = partial(run_training, net, training)
        yield NetworkCase(f"network {get_kind(net)}, {name}", run, (expects,), words)


def run_training(net: Net, training: Training, folder: Path) -> CaseOutput:
    """Train in `folder`, then infer from the validation batch with the kept network."""

    def make_batches(start: int) -> Iterator[Batch]:
        return (make_batch(net, step, training.batch) for step in itertools.count(start))

    validation = make_batch(net, VALIDATION, 4)
    task = make_task(net, training)
    data = TrainingData(make_batches, lambda: iter([validation]), epoch_images=training.batch)
    summary = train_network(task, training, data, 0, folder)
    log = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    terms = [{part: _fill_nulls(line[part]) for part in ("train", "validation")} for line in log]
    variables = checkpoint.load_best(folder)
    images = convert_to_floats(get_images(validation))
    outputs = dict(build_programs(net, TRAINING).infer(variables, images))
    arrays = {
        "log": terms,
        "best loss": summary.best_loss,
        "variables": variables,
        "outputs": outputs,
    }
    return describe_training(net, arrays, variables, summary.steps, terms[-1]["train"])


def _fill_nulls(terms: dict[str, float | None]) -> dict[str, float]:
    """Fill in NaN for a log's terms that were not finite, which JSON has as null."""
    return {name: np.nan if value is None else value for name, value in terms.items()}
