"""Runs the campaign, prints its rows and writes them as JSON.

python -m tests.faults --json docs/results/faults.json
python -m tests.faults --only corruption --bits 50 --keep FOLDER
"""

import argparse
import os
import sys
import tempfile
from dataclasses import asdict, fields
from importlib import import_module
from pathlib import Path

from tests.faults import shim

PARTS = {  # modules and functions, imported behind the shim alone
    "corruption": "corruption.list_rows",
    "writes": "file_systems.list_write_rows",
    "fuzz": "fuzz.list_rows",
    "kills": "processes.list_kill_rows",
    "memory": "processes.list_memory_rows",
    "others": "file_systems.list_other_rows",
}


def main() -> int:
    """Run the parts and return 0, or 1 if something was lost or silent."""
    arguments = _parse_arguments()
    if "FAULTS" not in os.environ:
        return _restart_with_shim()
    from tests.faults.outcome import Row, Size
    from tests.faults.places import make_places

    size = Size(**{field.name: getattr(arguments, field.name) for field in fields(Size)})
    root = arguments.keep or Path(tempfile.mkdtemp(prefix="faults-"))
    root.mkdir(parents=True, exist_ok=True)
    places, rows = make_places(root.resolve()), list[Row]()
    for part in arguments.only:
        module, _, function = PARTS[part].partition(".")
        list_rows = getattr(import_module(f"tests.faults.{module}"), function)
        with tempfile.TemporaryDirectory(prefix=f"{part}-") as scratch:
            for row in list_rows(places, size, Path(scratch).resolve()):
                rows.append(row)
                print(asdict(row), flush=True)
                _write(arguments.json, [asdict(row) for row in rows])
    return int(any(row.lost or row.silent for row in rows))


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--json", type=Path)
    keep = "where runs to be damaged are made, or lie already"
    parser.add_argument("--keep", type=Path, help=keep)
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    sizes = {"seed": 0, "bits": 500, "writes": 100, "moments": 30, "cases": 20_000}
    for name, default in sizes.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="that a row may take")
    return parser.parse_args()


def _write(path: Path | None, rows: list[dict]) -> None:
    """Write rows; those of another call that were not run again stay."""
    from jaxunshear.code_version import read_source
    from jaxunshear.files import read_json, write_json
    from jaxunshear.results.provenance import describe_provenance

    if path is not None:
        before = read_json(path)["rows"] if path.exists() else []
        command = " ".join(("python -m tests.faults", *sys.argv[1:]))
        made = [row | {"call": command, "source": read_source()} for row in rows]
        found = {(row["fault"], row["command"]): row for row in [*before, *made]}
        write_json(path, describe_provenance(command) | {"rows": list(found.values())})


def _restart_with_shim() -> int:
    """Run the same command in a process that has the shim."""
    with tempfile.TemporaryDirectory(prefix="shim-") as folder:
        library = str(shim.build(Path(folder)))
        environment = {
            "JAX_COMPILATION_CACHE_DIR": f"{folder}/compiled",
            **os.environ,
            "LD_PRELOAD": library,
            "FAULTS": library,
            "MPLBACKEND": "Agg",
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        words = [sys.executable, "-m", "tests.faults", *sys.argv[1:]]
        return os.spawnve(os.P_WAIT, sys.executable, words, environment)


if __name__ == "__main__":
    sys.exit(main())
