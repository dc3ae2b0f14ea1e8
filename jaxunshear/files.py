"""Reads, writes and locks files, and turns values into what JSON and CSV can hold.

Files are written beside their place and moved into it: a killed run leaves the old file or the new
one, never half. Symbolic links are followed. Pipes and devices are written into as they are.

>>> write_json(Path("runs/demo/results.json"), {"ms_ssim": 0.9})
>>> read_object(Path("runs/demo/results.json"))["ms_ssim"]
"""

import contextlib
import csv
import dataclasses
import errno
import hashlib
import io
import json
import os
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from jaxunshear.errors import UserError

if TYPE_CHECKING:
    import numpy as np

Json = dict[str, Any]  # an object whose keys are a command's own, as rows of its tables are
CHECKSUM_FIELD = "checksum"  # of an object of JSON, beside its fields
FULL_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT)
MACHINE_ERRORS = (
    *(errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.ENOMEM),
    *(errno.EIO, errno.ESTALE, errno.EROFS, *FULL_DISK_ERRORS),
)
BROKEN_NPZ = (  # what `read_npz` raises
    OSError,
    ValueError,
    EOFError,
    KeyError,
    RuntimeError,
    zlib.error,
    zipfile.BadZipFile,
    tokenize.TokenError,
)


def cache_folder() -> Path:
    """Return $JAXUNSHEAR_CACHE, or jaxunshear/ in the user's cache folder.

    Raises UserError if none is known.
    """
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
    """Turn an OSError at `path` into a line for people."""
    if error.errno in FULL_DISK_ERRORS:
        return UserError(
            f"cannot {verb} {path}: the disk is full; free some space, then run the same command"
        )
    return UserError(f"cannot {verb} {path}: {error.strerror or error}")


def raise_machine_error(path: Path, error: BaseException) -> None:
    """Raise UserError if an error in reading `path` is the machine's: no memory, right or space.

    So nobody is asked to delete a sound file. Errors that a library wrapped in its own count, too.
    """
    for cause in _iterate_causes(error):
        if isinstance(cause, MemoryError):
            raise UserError(f"cannot read {path}: there is not enough memory") from error
        if isinstance(cause, OSError) and cause.errno in MACHINE_ERRORS:
            raise explain_os_error(path, cause, "read") from error


def is_disk_full(error: BaseException) -> bool:
    """Return whether an error, or one that a library wrapped in it, says that the disk is full."""
    for cause in _iterate_causes(error):
        if isinstance(cause, OSError) and cause.errno in FULL_DISK_ERRORS:
            return True
        if "No space left on device" in str(cause) or "Disk quota exceeded" in str(cause):
            return True
    return False


def _iterate_causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def explain_stub(content: Path | bytes) -> str:
    """Say that a file, or its bytes, is empty or a pointer of Git LFS; "" for any other."""
    if isinstance(content, Path):
        with content.open("rb") as file:
            content = file.read(64)
    if content.startswith(b"version https://git-lfs"):
        return "it is a pointer of Git LFS, not the file itself: run `git lfs pull`"
    return "" if content else "it is empty: copy it again"


def read_npz(file: Path | BinaryIO) -> "dict[str, np.ndarray]":
    """Read all arrays by name. Raises one of BROKEN_NPZ.

    np.load trusts a header before it has compared the checksum, so a damaged header may give
    another array. Here the checksum is compared first.
    """
    import numpy as np

    with zipfile.ZipFile(file) as members:
        stored = {name.removesuffix(".npy"): members.read(name) for name in members.namelist()}
    return {name: np.load(io.BytesIO(array)) for name, array in stored.items()}


def write_bytes(path: Path, data: bytes) -> None:
    """Replace the file at `path`, or the one a link leads to, by `data`; make missing folders.

    Pipes and devices are written into, never replaced. Raises UserError that names the path.
    """
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            with path.open("wb") as file:
                file.write(data)
        else:
            _replace(Path(os.path.realpath(path)), data)
    except OSError as error:
        raise explain_os_error(path, error) from error


def _replace(path: Path, data: bytes) -> None:
    """Replace a file in one step: all of `data` is there, or the old file stays. Raises OSError."""
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
    """Replace `path` by `obj` as indented JSON in one step; an object gets a checksum.

    NaN and infinity become null, as JSON has neither.
    """
    content = to_builtins(obj)
    if isinstance(content, dict):
        content = add_checksum(content)
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> object:
    """Read JSON without its checksum.

    Raises UserError if the file is missing, is no JSON, or differs from its checksum.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise explain_os_error(path, error, "read") from error
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is not valid JSON ({error}): delete it and make it again"
        ) from error
    try:
        return check_and_remove_checksum(content)
    except ValueError as error:
        raise UserError(
            f"{path} is damaged ({error}): make it again, or, where you changed it by hand, "
            f"delete its line '{CHECKSUM_FIELD}'"
        ) from error


def compute_checksum(obj: object) -> str:
    """Compute a checksum of the values of `obj`, whatever their order and spacing in a file."""
    text = json.dumps(to_builtins(obj), sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def add_checksum(content: Json) -> Json:
    """Return an object with its checksum: a bit that flips in a digit leaves valid JSON."""
    bare = {name: value for name, value in content.items() if name != CHECKSUM_FIELD}
    return bare | {CHECKSUM_FIELD: compute_checksum(bare)}


def check_and_remove_checksum(content: Any) -> Any:
    """Return an object without its checksum; what has none is returned as it is.

    Raises ValueError if the checksum is of something else, or its name is damaged.
    """
    if not isinstance(content, dict) or not content:
        return content
    *names, last = content
    bare = {name: content[name] for name in names}
    agrees = content[last] == compute_checksum(bare)
    if agrees and last == CHECKSUM_FIELD:
        return bare
    if agrees or CHECKSUM_FIELD in content:
        raise ValueError("its checksum differs")
    return content


def read_object(path: Path) -> Json:
    """Read an object like `read_json`. Raises UserError if the file holds anything else."""
    content = read_json(path)
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise UserError(f"{path} holds no JSON object but a {kind}: delete it and make it again")
    return content


def read_object_if_sound(path: Path) -> Json | None:
    """Read an object; return None if the file is missing or damaged."""
    try:
        return read_object(path)
    except UserError:
        return None


def to_builtins(obj: Any) -> Any:
    """Convert to built-in types.

    Dataclasses become dictionaries, without fields that are None by default; arrays and their
    scalars become lists and numbers, paths become text; NaN and infinity become None.
    """
    if dataclasses.is_dataclass(obj):
        values = {}
        for field in dataclasses.fields(obj):
            value = getattr(obj, field.name)
            if value is not None or field.default is not None:
                values[field.name] = to_builtins(value)
        return values
    if isinstance(obj, Mapping):
        return {str(key): to_builtins(value) for key, value in obj.items()}
    if isinstance(obj, list | tuple):
        return [to_builtins(value) for value in obj]
    if isinstance(obj, float):
        return obj if obj - obj == 0 else None
    if obj is None or isinstance(obj, str | bool | int):
        return obj
    if isinstance(obj, Path):
        return str(obj)
    if hasattr(obj, "tolist"):  # numpy and JAX, without importing either
        return to_builtins(obj.tolist())
    raise TypeError(f"{type(obj).__name__} cannot be written as JSON")


def format_csv(table: Sequence[Mapping[str, object]]) -> str:
    """Format a heading with the names in the first row, then a line per row."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()


@contextlib.contextmanager
def hold_lock(path: Path, wait: bool) -> Iterator[bool]:
    """Hold the lock file `path` while the context is open; yield whether it could be had.

    With `wait` it waits until it can. The system frees the lock when the process dies, however it
    dies; the empty file stays. Raises UserError if the file cannot be written or locked.
    """
    from filelock import FileLock, Timeout  # only for this: help must be quick

    with contextlib.ExitStack() as stack:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(FileLock(path, blocking=wait, fallback_to_soft=False))
            free = True
        except Timeout:
            free = False
        except OSError as error:
            raise explain_os_error(path, error) from error
        yield free
