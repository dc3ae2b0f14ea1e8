"""Checkpoints of a training: the only file that knows Orbax.

FOLDER/model.json                        what is trained, with which settings
FOLDER/checkpoints/<step>/state          arrays by name (Orbax)
FOLDER/checkpoints/<step>/record.json    history up to here, the best step, digests of the arrays
                                         and of their files
FOLDER/summary.json                      once the training is finished
FOLDER/weights.npz                       of a released model, in the place of checkpoints: the
                                         arrays that using it takes, and their digest

A checkpoint is written under another name and then renamed, so a killed run leaves complete ones
only. The latest and the best are kept.
"""

import dataclasses
import hashlib
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp

from jaxunshear import files
from jaxunshear.config.serialization import OLD_FILES, add_version, remove_version
from jaxunshear.config.targets import Targets, count_outputs, from_json
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import Json
from jaxunshear.models.pin_networks import fold_tasks, move_frame
from jaxunshear.models.registry import find_misfit, find_settings_class
from jaxunshear.models.weights import Net, Variables, list_leaves

State = TypeVar("State")
MODEL, SUMMARY = "model.json", "summary.json"
WEIGHTS, DIGEST, FILES = "weights.npz", "digest", "files"
FRAME_SHIFT, TASK_SHARES = "frame_shift", "task_shares"  # in model.json: of the contacts to read


def save(folder: Path, step: int, state: object, record: Json) -> None:
    """Write the tree `state` and the JSON `record` (with "best_step") as checkpoint `step`.

    Then delete all checkpoints but this one and the best. Raises UserError if that fails; earlier
    checkpoints stay.
    """
    target = _get_path(folder, step)
    part = target.with_suffix(".part")
    arrays = list_leaves(jax.device_get(state))
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as writer:
            writer.save((part / "state").absolute(), arrays)
        digests = {DIGEST: _compute_digest(arrays), FILES: _compute_files_digest(part / "state")}
        files.write_json(part / "record.json", record | {"step": step} | digests)
        shutil.rmtree(target, ignore_errors=True)
        part.rename(target)
    except UserError:
        raise
    except Exception as error:  # a full disk raises many types
        raise UserError(
            f"cannot write checkpoint {target} ({get_first_line(error)}): is the disk full?"
        ) from error
    for path in target.parent.iterdir():
        if path not in (target, _get_path(folder, record["best_step"])):
            shutil.rmtree(path, ignore_errors=True)


def find_latest_step(folder: Path) -> int | None:
    """Find the step of the latest checkpoint in `folder`; None without one."""
    return max(_list_steps(folder), default=None)


def list_kept_steps(folder: Path) -> list[int]:
    """List the steps of the latest checkpoint in `folder` and of the best. Raises UserError."""
    step = find_latest_step(folder)
    if step is None:
        return []
    best_step = _read_record(folder, step)["best_step"]
    return [step] if best_step == step else [step, best_step]


def restore(folder: Path, step: int, like: State) -> tuple[State, Json]:
    """Restore the state of checkpoint `step`, in the form of the tree `like`, and its record.

    Raises UserError if the checkpoint is damaged.
    """
    arrays, record = _read(folder, step)
    expected = list_leaves(like)
    for name in arrays | expected:
        if (
            name not in arrays
            or name not in expected
            or np.shape(arrays[name]) != np.shape(expected[name])
        ):
            raise UserError(
                f"checkpoint {_get_path(folder, step)} does not fit this network ({name}): "
                f"delete {folder} to train again"
            )
    leaves = [jax.numpy.asarray(arrays[name]) for name in expected]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), record


def has_model(folder: Path) -> bool:
    """Return whether `folder` holds a network that `load_best` can read."""
    return (Path(folder) / WEIGHTS).exists() or find_latest_step(folder) is not None


def check_checkpoints(folder: Path) -> None:
    """Raise UserError if a training that was finished has lost its checkpoints."""
    if not has_model(folder):
        raise UserError(
            f"{folder} has lost its checkpoints: delete that folder, then run the same command"
        )


def check_training(folder: Path) -> None:
    """Raise UserError if the training in `folder` was started and not finished.

    Also raises UserError if its summary is damaged. Released weights count as finished.
    """
    folder = Path(folder)
    if (folder / SUMMARY).exists():
        files.read_object(folder / SUMMARY)
    elif (folder / MODEL).exists() and not (folder / WEIGHTS).exists():
        finish = (
            f"jaxunshear train FILE --network {folder.name} --out {folder.absolute().parents[1]}"
        )
        raise UserError(
            f"the training of {folder.name} in {folder} was not finished: finish it with `{finish}`"
        )


def load_best(folder: Path) -> Json:
    """Load the variables of the best checkpoint by validation loss, or those released.

    These are averaged weights and statistics. Raises UserError.
    """
    if (Path(folder) / WEIGHTS).exists():
        return _nest(_read_weights(Path(folder) / WEIGHTS))
    step = find_latest_step(folder)
    if step is None:
        raise UserError(
            f"{folder} holds no trained model (no checkpoints): train first, or name another folder"
        )
    arrays, _ = _read(folder, _read_record(folder, step)["best_step"])
    prefix = "average."
    averages = {
        name.removeprefix(prefix): array
        for name, array in arrays.items()
        if name.startswith(prefix)
    }
    return _nest(averages)


def compute_weights_digest(variables: Variables) -> str:
    """Compute the digest of variables as `load_best` returns them."""
    return _compute_digest(list_leaves(variables))


def write_weights(folder: Path, variables: Variables, modules: Sequence[str] = ()) -> None:
    """Write the arrays of `variables` to weights.npz in `folder`; with `modules`, only theirs.

    Kernels are kept as float16, which halves the file; biases and statistics as they are.
    """
    arrays = {}
    for name, leaf in list_leaves(jax.device_get(variables)).items():
        if modules and name.split(".")[1] not in modules:
            continue
        is_kernel = name.startswith("params.") and np.ndim(leaf) > 1
        arrays[name] = np.asarray(leaf, np.float16 if is_kernel else None)
    digest = {DIGEST: np.array(_compute_digest(arrays))}
    files.write_npz(Path(folder) / WEIGHTS, digest | arrays, compressed=True)


def _read_weights(path: Path) -> dict[str, np.ndarray]:
    try:
        arrays = files.read_npz(path)
        if str(arrays.pop(DIGEST)) != _compute_digest(arrays):
            raise ValueError("its digest differs")
        return arrays
    except files.BROKEN_NPZ as error:
        files.raise_machine_error(path, error)
        reason = files.explain_no_content(path.read_bytes()) or get_first_line(error)
        remedy = "install or copy these weights again"
        raise UserError(f"{path} is damaged ({reason}): {remedy}") from error


def _nest(arrays: Mapping[str, np.ndarray]) -> Json:
    """Turn {"params.E.First_0.kernel": ...} into nested dictionaries of arrays on the device.

    Arrays have at least 32 bits.
    """
    variables: Variables = {}
    for name, array in arrays.items():
        *modules, last = name.split(".")
        branch = variables
        for module in modules:
            branch = branch.setdefault(module, {})
        branch[last] = jax.numpy.asarray(array, np.promote_types(array.dtype, np.float32))
    return variables


def write_settings(folder: Path, settings: Json) -> None:
    """Keep the settings of a training in model.json.

    Raises UserError if the folder holds a training with other settings.
    """
    path = Path(folder) / MODEL
    if not path.exists():
        return files.write_json(path, add_version(settings))
    old, new = _flatten(_read_model(path)), _flatten(files.to_builtins(settings))
    for name in old | new:
        if old.get(name) != new.get(name):
            change = f"{name} = {old.get(name)}, now {new.get(name)}"
            raise UserError(
                f"{folder} holds a training with {change}: delete the folder or use another name"
            )


def read_net(folder: Path) -> Net:
    """Read the network's settings from model.json. Raises UserError."""
    path = Path(folder) / MODEL
    if not path.exists():
        raise UserError(
            f"{folder} holds no trained model (no {MODEL}): train first, or name another folder"
        )
    try:
        stored = _read_model(path)
        net_class = find_settings_class(stored["kind"])
        if net_class is None:
            raise UserError(
                f"{path}: kind = {stored['kind']}: no network has it: "
                "name the experiment file that registers it"
            )
        settings = {}
        for field in dataclasses.fields(net_class):
            value = stored["net"][field.name]
            settings[field.name] = tuple(value) if isinstance(value, list) else value
        return net_class(**settings)
    except (KeyError, TypeError) as error:
        raise UserError(
            f"{path} lacks or misnames {error} ({OLD_FILES}): delete {folder} and train again"
        ) from error


def _read_model(path: Path) -> Json:
    """Read model.json without its version. Raises UserError if another version wrote it."""
    return remove_version(files.read_object(path), path)


def read_slides(folder: Path) -> Targets:
    """Read the slide targets of a network's shear code, if any. Raises UserError."""
    path = Path(folder) / MODEL
    return from_json(files.read_object(path).get("slides", []), str(path))


def read_targets(folder: Path) -> Targets:
    """Read the pose targets that the network in `folder` has learnt, if any. Raises UserError."""
    path = Path(folder) / MODEL
    stored = files.read_object(path)
    if "targets" not in stored and stored.get("kind") != "posenet":
        return ()
    # None of a PoseNet that an earlier version trained, which `from_json` refuses
    return from_json(stored.get("targets"), str(path))


def _read(folder: Path, step: int) -> tuple[dict[str, np.ndarray], Json]:
    path, record = _get_path(folder, step), _read_record(folder, step)
    try:
        # Orbax' threads would report that at length
        if record[FILES] != _compute_files_digest(path / "state"):
            raise ValueError("its files are not those that were written")
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as reader:
            arrays = reader.restore((path / "state").absolute())
        if _compute_digest(arrays) != record[DIGEST]:
            raise ValueError("its digest differs")
        return arrays, record
    except Exception as error:  # a damaged file raises many types
        raise _make_damage_error(folder, path, error) from error


def _read_record(folder: Path, step: int) -> Json:
    path = _get_path(folder, step)
    try:
        record = files.read_object(path / "record.json")
        if not {"best_step", DIGEST, FILES, "history"} <= record.keys():
            raise UserError("its record is incomplete")
        return record
    except (UserError, AttributeError) as error:
        raise _make_damage_error(folder, path, error) from error


def _make_damage_error(folder: Path, path: Path, error: Exception) -> UserError:
    """Make the error of a damaged checkpoint; raise the error of a machine that fails to read."""
    files.raise_machine_error(path, error)
    steps = _list_steps(folder)
    # an earlier checkpoint may be the best one, which the record of a later one names
    is_latest = len(steps) > 1 and path == _get_path(folder, max(steps))
    back = f"delete {path} to go on from the one before, or " if is_latest else ""
    reason = get_first_line(error)
    return UserError(
        f"checkpoint {path} is damaged ({reason}): {back}delete {folder} to train from the start"
    )


def _list_steps(folder: Path) -> list[int]:
    root = Path(folder) / "checkpoints"
    if not root.is_dir():
        return []
    return [int(path.name) for path in root.iterdir() if path.name.isdigit()]


def _get_path(folder: Path, step: int) -> Path:
    return Path(folder) / "checkpoints" / f"{step:08d}"


def _compute_digest(arrays: Json) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def _compute_files_digest(folder: Path) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(folder)} {len(content)}".encode() + content)
    return digest.hexdigest()


def _flatten(tree: object, prefix: str = "") -> Json:
    """Turn nested JSON into {"train.epochs": 5}."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    flat: Json = {}
    for name, value in tree.items():
        flat |= _flatten(value, f"{prefix}.{name}" if prefix else name)
    return flat


def move_network(source: Path, target: Path, changes: Json, shift: Sequence[float]) -> None:
    """Copy a trained network to frames whose pins get to its own by `shift` px; none over images.

    `changes` replace fields of its model.json, such as TASK_SHARES of a network of several tasks.
    """
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)
    moved = {FRAME_SHIFT: list(shift)} if shift else {}
    files.write_json(target / MODEL, files.read_object(source / MODEL) | changes | moved)


class TrainedNetwork(NamedTuple):
    net: Net
    variables: Variables
    targets: Targets  # that it predicts, of a PoseNet


def load_network(folder: Path) -> TrainedNetwork:
    """Load a network from its folder. Raises UserError if it is missing, damaged or unfinished."""
    check_training(folder)
    net, variables, targets = read_net(folder), load_best(folder), read_targets(folder)
    stored = _read_model(Path(folder) / MODEL)
    variables = fold_tasks(variables, stored.get(TASK_SHARES))
    if moved := stored.get(FRAME_SHIFT):
        variables = move_frame(variables, moved)
    if misfit := find_misfit(net, variables, count_outputs(targets)):
        raise UserError(f"{folder}: its weights do not fit its {MODEL} ({misfit}): copy both again")
    return TrainedNetwork(net, variables, targets)
