"""Locks on folders, so that never two processes write into one. Imports no JAX."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from jaxunshear.files import explain_os_error


@contextlib.contextmanager
def hold_lock(path: Path, wait: bool) -> Iterator[bool]:
    """Holds the lock file `path` while open, for no other process to hold it; yields whether it could be had.

    `wait`: until it can. The system frees it when the process dies, however it dies; the empty file stays.
    Raises `UserError` where the file cannot be written or locked.
    """
    with contextlib.ExitStack() as held:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            held.enter_context(FileLock(path, blocking=wait, fallback_to_soft=False))
            free = True
        except Timeout:
            free = False
        except OSError as error:
            raise explain_os_error(path, error) from error
        yield free
