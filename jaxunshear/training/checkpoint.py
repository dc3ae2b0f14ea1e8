"""Checkpoints of a training: the only file that knows Orbax.

FOLDER/model.json                  what is trained, with which settings
FOLDER/checkpoints/<step>/state    arrays by name (Orbax)
FOLDER/checkpoints/<step>/record.json   history of the training up to here, the best step, digests of the arrays and of their files

FOLDER/summary.json                once the training has come to its end

FOLDER/weights.npz                 of a released model, in the place of checkpoints: the arrays that using it takes, and their digest

A checkpoint is written under another name and then renamed, so a killed run leaves complete ones only. The latest and the
best are kept.
"""

import dataclasses
import hashlib
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp

from jaxunshear import files
from jaxunshear.config.networks import (
    PinPoseNet,
    PinRenderer,
    PinUnshear,
    PoseNet,
    UNet,
    UnshearNet,
)
from jaxunshear.config.serialization import OLD_FILES, add_version, remove_version
from jaxunshear.config.targets import Targets, from_json
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import Json
from jaxunshear.models.weights import Net, Variables, list_leaves

State = TypeVar("State")
MODEL, SUMMARY = "model.json", "summary.json"
WEIGHTS, DIGEST, FILES = "weights.npz", "digest", "files"
NETS = {
    "unshear": UnshearNet,
    "unet": UNet,
    "posenet": PoseNet,
    "pin_unshear": PinUnshear,
    "pin_posenet": PinPoseNet,
    "renderer": PinRenderer,
}


def save(folder: Path, step: int, state: object, record: Json) -> None:
    """Write the tree `state` and the JSON `record` (with "best_step") as checkpoint `step`; then drop all but it and
    the best.

    Raises UserError where that fails; earlier checkpoints stay.
    """
    target = _path(folder, step)
    part = target.with_suffix(".part")
    arrays = list_leaves(jax.device_get(state))
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as writer:
            writer.save((part / "state").absolute(), arrays)
        digests = {DIGEST: _digest(arrays), FILES: _digest_of_files(part / "state")}
        files.write_json(part / "record.json", record | {"step": step} | digests)
        shutil.rmtree(target, ignore_errors=True)
        part.rename(target)
    except UserError:
        raise
    except Exception as error:  # a full disk reaches us as many types
        raise UserError(
            f"cannot write checkpoint {target} ({get_first_line(error)}): is the disk full?"
        ) from error
    for path in target.parent.iterdir():
        if path not in (target, _path(folder, record["best_step"])):
            shutil.rmtree(path, ignore_errors=True)


def find_latest_step(folder: Path) -> int | None:
    """Step of the latest checkpoint in `folder`; None without one."""
    return max(_steps(folder), default=None)


def list_kept_steps(folder: Path) -> list[int]:
    """Steps of the latest checkpoint in `folder` and, where it is another, of the best. Raises UserError."""
    step = find_latest_step(folder)
    return [] if step is None else list(dict.fromkeys((step, _record(folder, step)["best_step"])))


def restore(folder: Path, step: int, like: State) -> tuple[State, Json]:
    """The state of checkpoint `step`, in the form of the tree `like`, and its record. Raises UserError if it is
    damaged."""
    arrays, record = _read(folder, step)
    names = list_leaves(like)
    shapes, wanted = (
        {name: np.shape(leaf) for name, leaf in tree.items()} for tree in (arrays, names)
    )
    wrong = next((name for name in shapes | wanted if shapes.get(name) != wanted.get(name)), None)
    if wrong:
        path = _path(folder, step)
        raise UserError(
            f"checkpoint {path} does not fit this network ({wrong}): delete {folder} to train again"
        )
    leaves = [jax.numpy.asarray(arrays[name]) for name in names]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), record


def has_model(folder: Path) -> bool:
    """Whether `folder` holds a network that `load_best` can read."""
    return (Path(folder) / WEIGHTS).exists() or find_latest_step(folder) is not None


def check_finished(folder: Path) -> None:
    """Raises UserError where the training in `folder` was started and has not come to its end, or says so in a damaged file;
    released weights have come to it."""
    folder = Path(folder)
    if (folder / MODEL).exists() and not any(
        (folder / name).exists() for name in (SUMMARY, WEIGHTS)
    ):
        finish = (
            f"jaxunshear train FILE --network {folder.name} --out {folder.absolute().parents[1]}"
        )
        raise UserError(
            f"the training of {folder.name} in {folder} was not finished: finish it with `{finish}`"
        )
    if (folder / SUMMARY).exists():
        files.read_object(folder / SUMMARY)


def load_best(folder: Path) -> Json:
    """Variables (averaged weights and statistics) of the best checkpoint by validation loss, or those released. Raises UserError."""
    if (Path(folder) / WEIGHTS).exists():
        return _tree(_read_weights(Path(folder) / WEIGHTS))
    step = find_latest_step(folder)
    if step is None:
        raise UserError(
            f"{folder} holds no trained model (no checkpoints): train first, or name another folder"
        )
    arrays, _ = _read(folder, _record(folder, step)["best_step"])
    kept = {
        name.partition(".")[2]: array
        for name, array in arrays.items()
        if name.startswith("average.")
    }
    return _tree(kept)


def compute_weights_digest(folder: Path) -> str:
    """Of the variables that `load_best` gives: equal ones have equal digests. Raises UserError."""
    return _digest(list_leaves(load_best(folder)))


def write_weights(folder: Path, variables: Variables, modules: Sequence[str] = ()) -> None:
    """Writes the arrays of `variables` to weights.npz in `folder`; with `modules` named, those of these parts of the network.

    Kernels are kept as float16, which halves the file; biases and statistics as they are.
    """
    arrays = {
        name: np.asarray(
            leaf, np.float16 if np.ndim(leaf) > 1 and name.startswith("params.") else None
        )
        for name, leaf in list_leaves(jax.device_get(variables)).items()
        if not modules or name.split(".")[1] in modules
    }
    files.write_npz(
        Path(folder) / WEIGHTS, {DIGEST: np.array(_digest(arrays))} | arrays, compressed=True
    )


def _read_weights(path: Path) -> dict[str, np.ndarray]:
    try:
        arrays = files.read_npz(path)
        intact = str(arrays.pop(DIGEST)) == _digest(arrays)
    except files.BROKEN_NPZ as error:
        files.raise_machine_error(path, error)
        raise UserError(
            f"{path} is damaged ({get_first_line(error)}): install or copy these weights again"
        ) from error
    if not intact:
        raise UserError(
            f"{path} is damaged (its digest differs): install or copy these weights again"
        )
    return arrays


def _tree(arrays: Mapping[str, np.ndarray]) -> Json:
    """{"params.E.First_0.kernel": ...} as nested dictionaries of arrays on the device, of 32 bits at least."""
    variables: Variables = {}
    for name, array in arrays.items():
        *modules, last = name.split(".")
        place = variables
        for module in modules:
            place = place.setdefault(module, {})
        place[last] = jax.numpy.asarray(array, np.promote_types(array.dtype, np.float32))
    return variables


def write_settings(folder: Path, settings: Json) -> None:
    """Keep what a training was asked for in model.json. Raises UserError if the folder holds a training of other
    settings."""
    path = Path(folder) / MODEL
    if not path.exists():
        return files.write_json(path, add_version(settings))
    old, new = _flat(_read_model(path)), _flat(files.to_builtins(settings))
    for name in old | new:
        if old.get(name) != new.get(name):
            change = f"{name} = {old.get(name)}, now {new.get(name)}"
            raise UserError(
                f"{folder} holds a training with {change}: delete the folder or use another name"
            )


def read_net(folder: Path) -> Net:
    """The network's settings from model.json. Raises UserError."""
    path = Path(folder) / MODEL
    if not path.exists():
        raise UserError(
            f"{folder} holds no trained model (no {MODEL}): train first, or name another folder"
        )
    try:
        stored = _read_model(path)
        kind = NETS[stored["kind"]]
        fields = {field.name: stored["net"][field.name] for field in dataclasses.fields(kind)}
        return kind(
            **{
                name: tuple(value) if isinstance(value, list) else value
                for name, value in fields.items()
            }
        )
    except (KeyError, TypeError) as error:
        raise UserError(
            f"{path} lacks or misnames {error} ({OLD_FILES}): delete {folder} and train again"
        ) from error


def _read_model(path: Path) -> Json:
    """Read model.json without its version. Raises UserError if another version wrote it."""
    return remove_version(files.read_object(path), path)


def read_slides(folder: Path) -> Targets:
    """What the shear code of the network in `folder` says of the slide; nothing where it was not taught. Raises UserError."""
    path = Path(folder) / MODEL
    return from_json(files.read_object(path).get("slides", []), str(path))


def read_targets(folder: Path) -> Targets:
    """The pose targets that the network in `folder` has learnt, from model.json; none of one that has learnt no poses. Raises UserError."""
    path = Path(folder) / MODEL
    stored = files.read_object(path)
    if "targets" not in stored and stored.get("kind") != "posenet":
        return ()
    return from_json(
        stored.get("targets"), str(path)
    )  # a PoseNet that gives none was trained by an earlier version


def _read(folder: Path, step: int) -> tuple[dict[str, np.ndarray], Json]:
    path, record = _path(folder, step), _record(folder, step)
    try:
        if FILES in record and record[FILES] != _digest_of_files(path / "state"):
            raise ValueError(
                "its files are not those that were written"
            )  # Orbax' threads would say so at length
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as reader:
            arrays = reader.restore((path / "state").absolute())
        intact = _digest(arrays) == record[DIGEST]
    except Exception as error:  # whatever a damaged file makes of itself
        files.raise_machine_error(path, error)
        raise UserError(
            f"checkpoint {path} is damaged ({get_first_line(error)}): {_remedy(folder, path)}"
        ) from error
    if not intact:
        raise UserError(
            f"checkpoint {path} is damaged (its digest differs): {_remedy(folder, path)}"
        )
    return arrays, record


def _record(folder: Path, step: int) -> Json:
    path = _path(folder, step)
    try:
        record = files.read_object(path / "record.json")
        if not {"best_step", DIGEST, "history"} <= record.keys():
            raise UserError("its record is incomplete")
        return record
    except (UserError, AttributeError) as error:
        files.raise_machine_error(path, error)
        raise UserError(
            f"checkpoint {path} is damaged ({get_first_line(error)}): {_remedy(folder, path)}"
        ) from error


def _remedy(folder: Path, path: Path) -> str:
    steps = _steps(folder)
    last = len(steps) > 1 and path == _path(
        folder, max(steps)
    )  # the record of a later one may name an earlier one
    back = f"delete {path} to go on from the one before, or " if last else ""
    return f"{back}delete {folder} to train from the start"


def _steps(folder: Path) -> list[int]:
    root = Path(folder) / "checkpoints"
    return (
        [int(path.name) for path in root.iterdir() if path.name.isdigit()] if root.is_dir() else []
    )


def _path(folder: Path, step: int) -> Path:
    return Path(folder) / "checkpoints" / f"{step:08d}"


def _digest(arrays: Json) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def _digest_of_files(folder: Path) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(folder)} {len(content)}".encode() + content)
    return digest.hexdigest()


def _flat(tree: object, prefix: str = "") -> Json:
    """Nested JSON as {"train.epochs": 5}."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    flat: Json = {}
    for name, value in tree.items():
        flat |= _flat(value, f"{prefix}.{name}" if prefix else name)
    return flat
