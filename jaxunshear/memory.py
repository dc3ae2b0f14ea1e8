"""Keeps freed memory in the process. Imports no JAX.

XLA allocates one block for a step's intermediate arrays and frees it after each step; glibc returns such large blocks
to the kernel, and getting them back, page by page, cost a third of a training step on two cores.
"""

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # malloc.h


def keep_freed_memory() -> None:
    """Tells glibc to keep large freed blocks; does nothing where the C library is another."""
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
