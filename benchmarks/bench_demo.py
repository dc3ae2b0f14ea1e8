"""Measures how long each stage of `make demo` takes, installs apart.

The run begins as on a fresh clone: without data set, mesh of the dome and compiled program. The
column `products` is the time divided by the time of a 2048 x 2048 float32 matrix product, which is
measured before and after the run.
"""

import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.results.record_files import read_times
from jaxunshear.text_table import format_text_table
from verification.clock import make_matrix_product, time_call

EXPERIMENT = Path(__file__).resolve().parents[1] / "experiments" / "demo.py"
TOTAL, REST = "total", "start, compilation and the rest"
COLUMNS = ("name", "s", "products")
format_table = partial(format_text_table, columns=COLUMNS)


def bench_demo(experiment: Path = EXPERIMENT) -> list[Json]:
    """Return a row for each stage of a run, for all else, and for the sum, in seconds.

    Raises UserError if the run fails; what it printed is on the terminal.
    """
    product = make_matrix_product()
    products = [time_call(product) for _ in range(5)]
    with TemporaryDirectory() as folder:
        places = [f"--out={folder}/runs", f"--data={folder}/datasets"]
        command = [sys.executable, "-m", "jaxunshear", "run", str(experiment), *places]
        environment = os.environ | {"JAXUNSHEAR_CACHE": f"{folder}/cache"}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        start = time.perf_counter()
        code = subprocess.run(command, env=environment).returncode
        total_s = time.perf_counter() - start
        if code:
            raise UserError(f"{experiment} = exit code {code}: must be 0; see the lines above")
        (run,) = (Path(folder) / "runs").iterdir()
        stages = read_times(run)
    products += [time_call(product) for _ in range(5)]
    seconds = stages | {REST: total_s - sum(stages.values()), TOTAL: total_s}
    product_s = float(np.median(products))
    return [{"name": name, "s": s, "products": s / product_s} for name, s in seconds.items()]
