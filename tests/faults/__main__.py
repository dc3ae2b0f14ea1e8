"""Runs the campaign, prints its rows and writes them as JSON.

python -m tests.faults --json docs/results/faults.json
python -m tests.faults --only corruption --bits 50 --keep FOLDER
"""

import argparse
import os
import sys
import tempfile
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

from tests.faults import shim
from tests.faults.outcome import Row, Size

PARTS = ("corruption", "writes", "fuzz", "kills", "memory", "others")


def main() -> int:
    """0, or 1 where something was lost or silent."""
    arguments = _parsed()
    if "FAULTS" not in os.environ:
        return _again_with_the_shim()
    from tests.faults.places import make  # what is measured is imported behind the shim alone

    size = Size(
        *(
            getattr(arguments, name)
            for name in ("seed", "bits", "writes", "moments", "cases", "seconds")
        )
    )
    root = arguments.keep or Path(tempfile.mkdtemp(prefix="faults-"))
    root.mkdir(parents=True, exist_ok=True)
    places, rows = make(root.resolve()), list[Row]()
    for part in arguments.only:
        with tempfile.TemporaryDirectory(prefix=f"{part}-") as scratch:
            for row in import_module(f"tests.faults.{part}").rows(
                places, size, Path(scratch).resolve()
            ):
                rows.append(row)
                print(asdict(row), flush=True)
                _write(arguments.json, rows)
    return int(any(row.lost or row.silent for row in rows))


def _parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--keep", type=Path, help="where runs to be damaged are made, or lie already"
    )
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bits", type=int, default=500)
    parser.add_argument("--writes", type=int, default=100)
    parser.add_argument("--moments", type=int, default=30)
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="that a row may take")
    return parser.parse_args()


def _write(path: Path | None, rows: list[Row]) -> None:
    """Rows of another call that were not run again stay, each with its call and code."""
    from jaxunshear.code_version import read_source
    from jaxunshear.files import read_json, write_json
    from jaxunshear.metrics.machine import describe_provenance

    if path is not None:
        before = read_json(path)["rows"] if path.exists() else []
        command = " ".join(("python -m tests.faults", *sys.argv[1:]))
        made = [asdict(row) | {"call": command, "source": read_source()} for row in rows]
        found = {(row["fault"], row["command"]): row for row in [*before, *made]}
        write_json(path, describe_provenance(command) | {"rows": list(found.values())})


def _again_with_the_shim() -> int:
    """The same command in a process that has the shim, and whose results do not depend on who runs it."""
    with tempfile.TemporaryDirectory(prefix="shim-") as folder:
        library = shim.build(Path(folder))
        more = {"LD_PRELOAD": str(library), "FAULTS": str(library), "MPLBACKEND": "Agg"}
        more.setdefault(
            "JAX_COMPILATION_CACHE_DIR",
            os.environ.get("JAX_COMPILATION_CACHE_DIR", f"{folder}/compiled"),
        )
        more["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
        words = [sys.executable, "-m", "tests.faults", *sys.argv[1:]]
        return os.spawnve(os.P_WAIT, sys.executable, words, os.environ | more)


if __name__ == "__main__":
    sys.exit(main())
