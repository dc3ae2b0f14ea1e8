"""Describe the machine, the code and the versions that a figure was measured with."""

import os
import platform
from collections.abc import Iterable
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from jaxunshear.code_version import read_source
from jaxunshear.environment import count_cores
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.results.measurement import Machine, TrainingSummary
from jaxunshear.results.record_files import read_record

PACKAGES = (
    *("jaxunshear", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint"),
    *("numpy", "scipy", "scikit-image", "grain", "tensorflow-datasets"),
)


def describe_provenance(command: str, *more: str) -> Json:
    """Return what all results have: command, code, machine, versions with those of `more`."""
    return {
        "command": command,
        "source": read_source(),
        "machine": describe_machine(),
        "versions": list_versions(*more),
    }


def describe_machine() -> Machine:
    """Describe the processor, usable cores, memory, system and JAX device of this machine."""
    import jax

    device = jax.devices()[0]
    return Machine(
        processor=_read_processor(),
        cores=count_cores(),
        memory_gib=_read_memory_gib(),
        system=f"{platform.system()} {platform.machine()}",
        device=f"{device.platform}: {device.device_kind}",
    )


def list_versions(*more: str) -> dict[str, str]:
    """List the versions of Python, of PACKAGES and of `more`, if they are installed."""
    versions = {"python": platform.python_version()}
    for package in (*PACKAGES, *more):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _read_processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()


def _read_memory_gib() -> int:
    """Read the size of the memory; 0 if the system does not report it."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)
    except (ValueError, OSError, AttributeError):
        return 0


def read_training_facts(run_dir: Path, networks: Iterable[str]) -> Json:
    """Read the machine and the code that trained each of `networks`, if its summary has them."""
    trained_on, trained_by = {}, {}
    for name in networks:
        path = Path(run_dir) / name / "summary.json"
        with suppress(UserError):
            summary = read_record(path, TrainingSummary, "train again")
            if summary.trained_on != Machine():
                trained_on[name] = summary.trained_on
            if summary.trained_by:
                trained_by[name] = summary.trained_by
    return {"trained_on": trained_on, "trained_by": trained_by}
