"""Keeps freed memory in the process. Does not import JAX when it is imported.

XLA allocates one block for a step's intermediate arrays and frees it after each step. glibc returns
such large blocks to the kernel, and getting them back, page by page, cost a third of a training
step on two cores. glibc always returns what threads other than the first allocate, so computations
run in the thread that calls them.
"""

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # malloc.h


def keep_freed_memory() -> None:
    """Make glibc keep large freed blocks, and JAX compute in the calling thread.

    The first has no effect with another C library, the second none if JAX has computed already.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
