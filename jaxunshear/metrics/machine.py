"""On what, and with which code and versions, a figure was measured."""

import os
import platform
from importlib import metadata
from pathlib import Path

from jaxunshear.code_version import read_source
from jaxunshear.environment import count_cores
from jaxunshear.files import Json
from jaxunshear.results.measurement import Machine

PACKAGES = (
    *("jaxunshear", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint"),
    *("numpy", "scipy", "scikit-image", "grain", "tensorflow-datasets"),
)


def describe_provenance(command: str, *more: str) -> Json:
    """Return the fields that every result has: its command, code, machine, and versions, those of `more` with them."""
    return {
        "command": command,
        "source": read_source(),
        "machine": describe_machine(),
        "versions": list_versions(*more),
    }


def describe_machine() -> Machine:
    """Processor, usable cores, memory in GiB, system and JAX device of this machine."""
    import jax

    device = jax.devices()[0]
    return Machine(
        processor=_processor(),
        cores=count_cores(),
        memory_gib=_memory_gib(),
        system=f"{platform.system()} {platform.machine()}",
        device=f"{device.platform}: {device.device_kind}",
    )


def list_versions(*more: str) -> dict[str, str]:
    """Versions of Python, of each package that shapes the numbers, and of `more`; packages not installed are left out."""
    found = {"python": platform.python_version()}
    for package in (*PACKAGES, *more):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()


def _memory_gib() -> int:
    """0 where the system does not say."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)
    except (ValueError, OSError, AttributeError):
        return 0
