"""Locks on folders, so that never two processes write into one. Imports no JAX."""

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

from jaxunshear.storage import os_error


@contextlib.contextmanager
def locked(path: Path, wait: bool) -> Iterator[bool]:
    """Holds the lock file `path` while open, for no other process to hold it; yields whether it could be had.

    `wait`: until it can. The system frees it when the process dies, however it dies; the empty file stays.
    Raises `UserError` where the file cannot be written or locked.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a")
    except OSError as error:
        raise os_error(path, error) from error
    with file:
        free = True
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            free = False
        except OSError as error:
            raise os_error(path, error, "lock") from error
        yield free
