"""The code that a process runs: its version, and of a git checkout the commit. Imports no JAX."""

import os
import subprocess
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from jaxunshear import __version__
from jaxunshear.results.measurement import Source

ROOT = Path(__file__).resolve().parents[1]
# what decides a result
CODE_PATHS = (
    *("jaxunshear", "verification", "benchmarks", "data_specs", "experiments"),
    *("pyproject.toml", "constraints.txt"),
)
GIT_VARIABLES = (
    "GIT_DIR",
    "GIT_WORK_TREE",
    "GIT_INDEX_FILE",
)  # a hook of another repository sets them
SECONDS = 20


@cache
def read_source() -> Source:
    """Return the code that this process runs, as it was when first asked.

    An installed package has no commit. Neither has a checkout where git is missing or refuses.
    """
    return Source(__version__, datetime.now(UTC).date().isoformat(), *read_commit(ROOT))


def read_commit(root: Path) -> tuple[str | None, bool | None]:
    """Return the commit of the checkout at `root`, and whether its CODE is as committed.

    Both are None if there is none.
    """
    if not (root / ".git").exists():  # a checkout may hold this package in an environment alone
        return None, None
    words = [
        "git",
        "--no-optional-locks",
        "status",
        "--porcelain=v2",
        "--branch",
        "--",
        *CODE_PATHS,
    ]
    here = {name: value for name, value in os.environ.items() if name not in GIT_VARIABLES}
    try:
        done = subprocess.run(
            words, cwd=root, env=here, capture_output=True, text=True, timeout=SECONDS
        )
    except (OSError, subprocess.TimeoutExpired):
        return None, None
    lines = done.stdout.splitlines()
    named = [line.split()[-1] for line in lines if line.startswith("# branch.oid ")]
    if done.returncode or not named or named[0] == "(initial)":
        return None, None
    return named[0], all(line.startswith("#") for line in lines)
