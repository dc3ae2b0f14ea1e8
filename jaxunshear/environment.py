"""What the environment may decide: on which device, and where files are kept. Not what comes out. Does not import JAX."""

import errno
import os
import subprocess
import sys
from collections.abc import Iterable
from functools import cache

from jaxunshear.errors import UserError
from jaxunshear.files import cache_folder

# Of JAX's variables those of devices, caches and messages; others decide keys, number types or what is allowed
RESPECTED_VARIABLES = (
    *("JAX_PLATFORM", "JAX_CUDA_", "JAX_ROCM_", "JAX_COMPILATION_CACHE_", "JAX_PERSISTENT_CACHE_"),
    *("JAX_ENABLE_COMPILATION_CACHE", "JAX_LOG", "JAX_DEBUG_LOG_", "JAX_TRACEBACK_", "JAX_DUMP_"),
)
DEVICE_VARIABLES = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME", "XLA_FLAGS")
ROUNDING = ("fast_math", "fast_min_max", "precision")  # in names of XLA's flags
PROBE = "import jax; jax.devices()"
KERNELS_VARIABLE = (
    "JAXUNSHEAR_KERNELS"  # which layers networks are built of, see `models/layer_choice.py`
)
KERNEL_CHOICES = AUTO, PLAIN, FAST = ("auto", "plain", "fast")
DEVICE_COUNT = "JAXUNSHEAR_DEVICES"  # how many a training is spread over, see `training/devices.py`
SECONDS = 120  # a GPU on a busy machine needs some


def check_variables() -> None:
    """Raise UserError if a variable of JAX in the environment would change results."""
    found = [
        f"{name}={value}"
        for name, value in sorted(os.environ.items())
        if name.startswith("JAX_") and not name.startswith(RESPECTED_VARIABLES)
    ]
    if found:
        raise UserError(
            f"{', '.join(found)}: would give other results under the same name: unset it"
        )


def count_cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_environment() -> None:
    """Raises UserError, before there is work to lose, where the environment names no place for a cache, devices that are not there,
    variables or flags that would change results, or layers or a number of devices that there cannot be."""
    check_variables()
    cache_folder()
    read_kernels_choice()
    read_device_count()
    flags = os.environ.get("XLA_FLAGS", "").split()
    for flag in flags:
        if any(word in flag for word in ROUNDING):
            raise UserError(
                f"XLA_FLAGS: {flag} would give other results under the same name: leave it out"
            )
    asked = {
        name: os.environ[name]
        for name in DEVICE_VARIABLES
        if os.environ.get(name, "") not in ("", "cpu")
    }
    reported = ", ".join(f"{name}={value}" for name, value in asked.items())
    if asked and not _starts(reported):
        raise UserError(
            f"{reported}: JAX cannot start with that on this machine; unset it, or name what is there"
        )


def read_kernels_choice() -> str:
    """Of KERNEL_WAYS. Raises UserError."""
    way = os.environ.get(KERNELS_VARIABLE) or AUTO
    if way not in KERNEL_CHOICES:
        raise UserError(
            f"{KERNELS_VARIABLE}={way} is unknown: use one of {', '.join(KERNEL_CHOICES)}"
        )
    return way


def read_device_count() -> int | None:
    """1 unless asked; None for all that there are. Raises UserError."""
    word = os.environ.get(DEVICE_COUNT) or "1"
    if word != "all" and not (word.isdecimal() and int(word) >= 1):
        raise UserError(f"{DEVICE_COUNT}={word}: use a number of devices from 1 on, or all")
    return None if word == "all" else int(word)


@cache
def _starts(asked: str) -> bool:
    """Whether JAX starts with what is `asked`, once a process. In one of its own: XLA ends the one that meets a bad flag, and a sweep is to
    leave the devices to its rows."""
    try:
        return (
            subprocess.run(
                [sys.executable, "-c", PROBE], capture_output=True, timeout=SECONDS
            ).returncode
            == 0
        )
    except subprocess.TimeoutExpired:
        return False


def check_links(paths: Iterable[object]) -> None:
    """Raises UserError for a path that is, or lies in, a link that leads back to itself."""
    for path in paths:
        if isinstance(path, os.PathLike):
            try:
                os.stat(path)
            except OSError as error:
                if error.errno == errno.ELOOP:
                    raise UserError(
                        f"{path} is, or lies in, a link that leads back to itself: name another"
                    ) from None
