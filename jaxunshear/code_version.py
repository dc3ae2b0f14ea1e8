"""Reads the version of the code, and the commit of a git checkout. Imports no JAX."""

import os
import subprocess
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from jaxunshear import __version__
from jaxunshear.results.measurement import Source

ROOT = Path(__file__).resolve().parents[1]
CODE_PATHS = (  # what decides a result
    *("jaxunshear", "verification", "benchmarks", "data_specs", "experiments"),
    *("pyproject.toml", "constraints.txt"),
)
STATUS = ("git", "--no-optional-locks", "status", "--porcelain=v2", "--branch", "--", *CODE_PATHS)
# a hook of another repository sets them
GIT_VARIABLES = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")
TIMEOUT_S = 20


@cache
def read_source() -> Source:
    """Return the code that this process runs, as it was when first asked.

    An installed package has no commit. Neither has a checkout where git is missing or refuses.
    """
    return Source(__version__, datetime.now(UTC).date().isoformat(), *read_commit(ROOT))


def read_commit(root: Path) -> tuple[str | None, bool | None]:
    """Return the commit of the checkout at `root`, and whether CODE_PATHS are as committed.

    Both are None if there is none.
    """
    if not (root / ".git").exists():  # a checkout may hold this package in an environment alone
        return None, None
    variables = {name: value for name, value in os.environ.items() if name not in GIT_VARIABLES}
    try:
        done = subprocess.run(
            STATUS, cwd=root, env=variables, capture_output=True, text=True, timeout=TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return None, None
    lines = done.stdout.splitlines()
    commits = [line.split()[-1] for line in lines if line.startswith("# branch.oid ")]
    if done.returncode or not commits or commits[0] == "(initial)":
        return None, None
    return commits[0], all(line.startswith("#") for line in lines)
