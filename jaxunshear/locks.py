"""Locks folders, so that never two processes write into one. Imports no JAX."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from jaxunshear.files import explain_os_error


@contextlib.contextmanager
def hold_lock(path: Path, wait: bool) -> Iterator[bool]:
    """Hold the lock file `path` while the context is open; yield whether it could be had.

    With `wait` it waits until it can. The system frees the lock when the process dies, however it
    dies; the empty file stays. Raises UserError if the file cannot be written or locked.
    """
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
