"""What all tests share. Real recordings are third-party and lie beside the checkout, if at all."""

import functools
import gc
import os
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from threadpoolctl import threadpool_limits


def open_program_cache(folder: Path) -> Path:
    """Make the folder of compiled programs, without what a killed run may have cut in it.

    JAX never writes an entry again. One that is too large is emptied: it also has what no test
    compiles any more.
    """
    folder.mkdir(parents=True, exist_ok=True)
    entries = {file: file.stat() for file in folder.iterdir()}
    last = max((entry.st_mtime for entry in entries.values()), default=0)
    too_large = sum(entry.st_size for entry in entries.values()) > LARGEST_CACHE
    for file, entry in entries.items():
        if too_large or entry.st_mtime > last - 5:
            file.unlink(missing_ok=True)
    return folder


# Many tests, their workers and the processes they start compile the same programs: once is enough,
# and they are kept for the next run; `make clean` removes them. A program is found again if XLA's
# flags are the same. They compute little, so it need not be optimised: `XLA_FLAGS= make test` tests
# what users run, in twice the time. JAX reads all of these when it is imported.
COMPILED, LARGEST_CACHE = "JAX_COMPILATION_CACHE_DIR", 2**30
if COMPILED not in os.environ:  # workers have it from the process that started them
    programs = Path(__file__).resolve().parents[1] / ".pytest_cache" / "programs"
    os.environ[COMPILED] = str(open_program_cache(programs))
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
# without the second flag doubles are wrong
FLAGS = "--xla_backend_optimization_level=0 --xla_backend_extra_options=-fast-isel=false"
# later ones do not know the flag; older emitters compile in half the time
if version("jaxlib").startswith("0.10."):
    FLAGS += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", FLAGS)
os.environ.setdefault("MPLBACKEND", "Agg")
# Threads of BLAS and OpenMP sleep while they have no work: other workers need the cores.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# JAX keeps much of what it compiled; to search it for what nobody needs took 7 % of the time.
gc.set_threshold(50_000, 20, 100)

from tests import shapes  # noqa: E402

shapes.check_all()
REAL = Path(__file__).resolve().parents[1].parent / "shared" / "real"


@pytest.fixture(scope="session")
def real_recordings() -> Path:
    """Folder of real recordings; skips where it is absent."""
    if not REAL.is_dir():
        pytest.skip(f"needs the real recordings in {REAL}, which no clone has")
    return REAL


STRICT = {
    "simulator",
    "metrics",
    "models",
    "test_losses.py",
    "test_rotation.py",
    "test_domain_randomisation.py",
    "test_drawing.py",
    "test_large_strain.py",
}


@pytest.fixture(scope="module", autouse=True)
def strict(request: pytest.FixtureRequest) -> Iterator[None]:
    """Make JAX broadcast and promote numbers only where that is written, in these folders."""
    import jax

    if not STRICT.intersection(request.path.relative_to(Path(__file__).parent).parts):
        yield
        return
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(scope="module", autouse=True)
def one_blas_thread(request: pytest.FixtureRequest) -> Iterator[None]:
    """Give BLAS one thread where kernel ridge regression is tested.

    On cores that other tests use, threads that wait for each other take ten times as long. Nowhere
    else: the last bits of golden figures depend on the number of threads.
    """
    if "evaluation" not in request.path.relative_to(Path(__file__).parent).parts:
        yield
        return
    with threadpool_limits(1, "blas"):
        yield


# They take a worker longest; started last, they would keep one waiting for the other. The runs come
# first: later files find what these compiled.
FIRST = (
    *("test_run.py", "recordings/test_laboratory.py", "recordings/test_tasks.py"),
    *("recordings/test_adapt.py", "recordings/test_layout.py", "test_notebooks.py"),
    *("test_cli_applications.py", "calibration/test_calibrate.py"),
    *("sweep/test_run.py", "evaluation/test_leakage.py"),
    *("evaluation/test_probes.py", "evaluation/test_pose_estimators.py"),
    "training/test_trainer.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {Path(__file__).parent / name: place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: order.get(item.path, len(order)))


# Files of a folder that share a run or a simulation: one worker takes them all, and makes it once.
SHARING = {
    "recordings": ("laboratory", "tasks", "adapt", "small_sets"),
    "calibration": ("calibrate", "validate"),
    "evaluation": ("code_swaps", "network_outputs", "stage"),
}
TOGETHER = {f"tests/{at}/test_{name}.py": at for at, names in SHARING.items() for name in names}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give a worker a file at a time, or all of those that share."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return TOGETHER.get(file, file)

    return Scheduling(config, log) if config.getvalue("dist") == "loadfile" else None


class Answer(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """`absent("ray")`: that module is not installed."""
    return lambda name: monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """For commands that walk and reconstruct: 8 steps around the disk, and scales of few taps."""
    from jaxunshear.data import simulation
    from jaxunshear.downstream import servo
    from jaxunshear.downstream.contour import trace_contour
    from jaxunshear.simulator.stimuli import STIMULI

    steps = 8 * 0.5 / trace_contour(STIMULI["disk"]).length
    monkeypatch.setattr(
        servo, "ServoTask", functools.partial(servo.ServoTask, max_outline_lengths=steps)
    )
    monkeypatch.setattr(simulation, "SCALE_TAPS", 12)


def call_with(
    main: Callable[[list[str]], int], capsys: pytest.CaptureFixture[str]
) -> Callable[..., Answer]:
    """Return a function that calls a command line in this process."""

    def call(*argv: object) -> Answer:
        capsys.readouterr()
        code = main([str(word) for word in argv])
        return Answer(code, *capsys.readouterr())

    return call


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """`command("run", "x.py")`: `jaxunshear run x.py`."""
    from jaxunshear.cli import main

    return call_with(main, capsys)


@pytest.fixture
def verification(capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """`verification("verify")`: `python -m verification verify`."""
    from verification.commands import main

    return call_with(main, capsys)


@pytest.fixture
def benchmarks(capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """`benchmarks("sim")`: `python -m benchmarks sim`."""
    from benchmarks.commands import main

    return call_with(main, capsys)
