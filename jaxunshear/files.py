"""Files are written beside their place and moved into it: a killed run leaves the old file or the new one, never half.

Symbolic links are followed. Pipes and devices are written into as they are.

>>> write_json(Path("runs/demo/results.json"), {"ms_ssim": 0.9})
>>> read_object(Path("runs/demo/results.json"))["ms_ssim"]
"""

import contextlib
import errno
import hashlib
import io
import json
import os
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from jaxunshear.errors import UserError
from jaxunshear.serialization import to_builtins

if TYPE_CHECKING:
    import numpy as np

Json = dict[str, Any]  # an object whose keys are a command's own, as rows of its tables are


CHECKSUM_FIELD = "checksum"  # of an object of JSON, beside its fields


def cache_folder() -> Path:
    """$JAXUNSHEAR_CACHE, or jaxunshear/ in the user's cache folder. Raises `UserError` where none is known."""
    if os.environ.get("JAXUNSHEAR_CACHE"):
        return Path(os.environ["JAXUNSHEAR_CACHE"])
    from platformdirs import user_cache_path  # only for this: help must be quick

    try:
        return user_cache_path("jaxunshear")
    except RuntimeError:  # a user without a name, as in a container
        raise UserError(
            "no home folder is known to keep a cache in: set HOME, or JAXUNSHEAR_CACHE, to a folder"
        ) from None


def explain_os_error(path: Path, error: OSError, verb: str = "write") -> UserError:
    """The line for people that an `OSError` at `path` deserves."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UserError(
            f"cannot {verb} {path}: the disk is full; free some space, then run the same command"
        )
    return UserError(f"cannot {verb} {path}: {error.strerror or error}")


MACHINE_ERRORS = (
    "EACCES",
    "EPERM",
    "EMFILE",
    "ENFILE",
    "ENOMEM",
    "EIO",
    "ESTALE",
    "EROFS",
    "ENOSPC",
    "EDQUOT",
)


def raise_machine_error(path: Path, error: BaseException) -> None:
    """Raises a `UserError` where `error`, met in reading `path`, says nothing about the file: no memory, no right, no place.

    Also when a library wrapped it in one of its own. So nobody is asked to delete what is sound.
    """
    codes = {getattr(errno, name, None) for name in MACHINE_ERRORS}
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            raise UserError(f"cannot read {path}: there is not enough memory") from error
        if isinstance(cause, OSError) and cause.errno in codes:
            raise explain_os_error(path, cause, "read") from error
        cause = cause.__cause__ or cause.__context__


def is_disk_full(error: BaseException | None) -> bool:
    """Also when a library wrapped the operating system's error in one of its own."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        if "No space left on device" in str(error) or "Disk quota exceeded" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


# Of `read_npz`.
BROKEN_NPZ = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    RuntimeError,
    zlib.error,
    zipfile.BadZipFile,
    tokenize.TokenError,
)


def read_npz(file: Path | BinaryIO) -> "dict[str, np.ndarray]":
    """All arrays by name. np.load trusts a header before it has compared the checksum, so that a damaged one may be another array;
    here it is compared first. Raises one of BROKEN_NPZ."""
    import numpy as np

    with zipfile.ZipFile(file) as members:
        stored = {name.removesuffix(".npy"): members.read(name) for name in members.namelist()}
    return {name: np.load(io.BytesIO(array)) for name, array in stored.items()}


def write_bytes(path: Path, data: bytes) -> None:
    """Replace the file at `path`, or the one a link leads to, by `data` in one step; make missing folders.

    Pipes and devices are written into, never replaced. Raises `UserError` that names the path.
    """
    try:
        if is_device(path):
            with path.open("wb") as file:
                file.write(data)
        else:
            _replace(follow_link(path), data)
    except OSError as error:
        raise explain_os_error(path, error) from error


def _replace(path: Path, data: bytes) -> None:
    """Replace the file at `path` by `data`: all of it is there, or the old file stays. Raises OSError."""
    part = path.with_name(path.name + ".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError:
        with contextlib.suppress(OSError):  # the first error is the one worth reporting
            part.unlink(missing_ok=True)
        raise


def follow_link(path: Path) -> Path:
    """Return the absolute place of `path`; where it is a link, the place that this leads to."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path.absolute()


def is_device(path: Path) -> bool:
    """Say whether `path` is neither file nor folder but a pipe, a device or the like, or leads to one."""
    return path.exists() and not (path.is_file() or path.is_dir())


def write_npz(path: Path, arrays: "Mapping[str, np.ndarray]", compressed: bool = False) -> None:
    """Replace `path` by arrays by name in one step, for `read_npz`."""
    import numpy as np

    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **arrays)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


def write_text(path: Path, text: str) -> None:
    """Replace `path` by UTF-8 `text` in one step."""
    write_bytes(path, text.encode())


def write_json(path: Path, obj: object) -> None:
    """Replace `path` by `obj` as indented JSON in one step; NaN and infinity become null, as JSON has neither. Objects are sealed."""
    held = to_builtins(obj)
    write_text(
        path,
        json.dumps(
            add_checksum(held) if isinstance(held, dict) else held, indent=2, allow_nan=False
        )
        + "\n",
    )


def read_json(path: Path) -> object:
    """What `path` holds, without its seal. Raises `UserError` where it is missing, is no JSON, or is not what was sealed."""
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise explain_os_error(path, error, "read") from error
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is not valid JSON ({error}): delete it and make it again"
        ) from error
    try:
        return check_and_remove_checksum(held)
    except ValueError as error:
        remedy = (
            f"make it again, or, where you changed it by hand, delete its line '{CHECKSUM_FIELD}'"
        )
        raise UserError(f"{path} is damaged ({error}): {remedy}") from error


def compute_checksum(obj: object) -> str:
    """Of what JSON keeps of `obj`: its values, whatever their order and spacing in a file."""
    return hashlib.blake2b(
        json.dumps(to_builtins(obj), sort_keys=True).encode(), digest_size=16
    ).hexdigest()


def add_checksum(held: Json) -> Json:
    """With its checksum beside it: a bit that flips in a digit leaves valid JSON, of another figure."""
    bare = {name: value for name, value in held.items() if name != CHECKSUM_FIELD}
    return bare | {CHECKSUM_FIELD: compute_checksum(bare)}


def check_and_remove_checksum(held: Any) -> Any:
    """Without its checksum; what bears none is taken as it is. Raises ValueError where it is of something else, or its name is damaged."""
    if not isinstance(held, dict) or not held:
        return held
    *names, last = held
    kept = {name: held[name] for name in names}
    agrees = held[last] == compute_checksum(kept)
    if agrees and last == CHECKSUM_FIELD:
        return kept
    if agrees or CHECKSUM_FIELD in held:
        raise ValueError("its checksum differs")
    return held


def read_object(path: Path) -> Json:
    """An object that `path` holds, as `read_json`. Raises `UserError` where it holds anything else, such as a list."""
    held = read_json(path)
    if not isinstance(held, dict):
        raise UserError(
            f"{path} holds no JSON object but a {type(held).__name__}: delete it and make it again"
        )
    return held


def read_object_if_sound(path: Path) -> Json | None:
    """What `path` holds; None where it is missing or damaged, for files that are not worth stopping for."""
    try:
        return read_object(path)
    except UserError:
        return None
