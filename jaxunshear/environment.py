"""Checks what surrounds a process, prepares it, keeps freed memory. Imports JAX only where needed.

Variables may decide on which device work runs and where files are kept, not what comes out.
"""

import ctypes
import io
import os
import signal
import sys
from types import FrameType

from jaxunshear.errors import UserError
from jaxunshear.files import cache_folder

# JAX's variables of devices, caches and messages; others decide keys or number types
RESPECTED_VARIABLES = (
    *("JAX_PLATFORM", "JAX_CUDA_", "JAX_ROCM_", "JAX_COMPILATION_CACHE_", "JAX_PERSISTENT_CACHE_"),
    *("JAX_ENABLE_COMPILATION_CACHE", "JAX_LOG", "JAX_DEBUG_LOG_", "JAX_TRACEBACK_", "JAX_DUMP_"),
)
COMMON_PLATFORMS = {"", "cpu", "gpu", "cuda", "rocm", "tpu"}
NVIDIA_DEVICES = ("/dev/nvidia0", "/dev/nvidiactl", "/dev/dxg")  # where JAX finds a GPU
ROUNDING = ("fast_math", "fast_min_max", "precision")  # in names of XLA's flags
KERNELS_VARIABLE = "JAXUNSHEAR_KERNELS"  # which layers networks have, see `models/layer_choice.py`
KERNEL_CHOICES = AUTO, PLAIN, FAST = ("auto", "plain", "fast")
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # malloc.h
DEVICE_COUNT = "JAXUNSHEAR_DEVICES"  # devices of a training, see `training/devices.py`


def prepare_process() -> None:
    """Make standard streams writable, and have SIGTERM and SIGHUP stop a program as Ctrl-C does.

    To be called before JAX is imported. Without standard streams the next open files would take
    their numbers, and messages of C++ go there. Child processes do not import modules of the
    working folder, such as a `random.py`.
    """
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    # XLA's log has alarms that harm nothing: of programs that compile slowly, and one for each kept
    # program, as tuning flags are no features of the processor; errors are exceptions in any case
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:  # closed by whoever started this process
            mode = os.O_WRONLY if number else os.O_RDONLY
            setattr(sys, name, os.fdopen(os.open(os.devnull, mode), "w" if number else "r"))
        elif number and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # letters that its encoding lacks
    for stop in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(stop) is signal.SIG_DFL:  # `nohup` has it ignored
            signal.signal(stop, _stop)


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(number)


def check_variables() -> None:
    """Raise UserError if a variable of JAX or a flag of XLA would change results."""
    refused = [
        f"{name}={value}"
        for name, value in sorted(os.environ.items())
        if name.startswith("JAX_") and not name.startswith(RESPECTED_VARIABLES)
    ]
    for flag in os.environ.get("XLA_FLAGS", "").split():
        if any(word in flag for word in ROUNDING):
            refused.append(f"XLA_FLAGS={flag}")
    if refused:
        raise UserError(
            f"{', '.join(refused)}: would give other results under the same name: unset it"
        )


def check_environment() -> None:
    """Check the environment before there is work to lose.

    Raises UserError if it names no place for a cache, variables or flags that would change results,
    or layers or a number of devices that cannot be; RuntimeError for devices that are not there.
    """
    check_variables()
    cache_folder()
    read_kernels_choice()
    read_device_count()
    platforms = set(os.environ.get("JAX_PLATFORMS", "cpu").split(","))
    if platforms == {"cuda"} and not any(map(os.path.exists, NVIDIA_DEVICES)):
        raise UserError("JAX_PLATFORMS=cuda: no NVIDIA GPU is on this machine: unset it")
    if not platforms <= COMMON_PLATFORMS:
        import jax  # not for a common one: this process would hold the memory of a GPU

        jax.devices()  # RuntimeError, which names the variable, if there are none of these


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def read_kernels_choice() -> str:
    """Return one of KERNEL_CHOICES. Raises UserError."""
    choice = os.environ.get(KERNELS_VARIABLE) or AUTO
    if choice not in KERNEL_CHOICES:
        raise UserError(
            f"{KERNELS_VARIABLE}={choice} is unknown: use one of {', '.join(KERNEL_CHOICES)}"
        )
    return choice


def read_device_count() -> int | None:
    """Return how many devices a training may use, None for all. Raises UserError."""
    word = os.environ.get(DEVICE_COUNT) or "1"
    if word != "all" and not (word.isdecimal() and int(word) >= 1):
        raise UserError(f"{DEVICE_COUNT}={word}: use a number of devices from 1 on, or all")
    return None if word == "all" else int(word)


def keep_compiled_programs() -> None:
    """Keep what JAX compiles in the user's cache folder, unless a variable names another place."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "programs"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def keep_freed_memory() -> None:
    """Make glibc keep large freed blocks, and JAX compute in the calling thread.

    XLA allocates one block for a step's intermediate arrays and frees it after each step. glibc
    returns such large blocks to the kernel, and getting them back, page by page, cost a third of a
    training step on two cores. It always returns what threads other than the first allocate.
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
