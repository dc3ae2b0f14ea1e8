"""`check bench`: error against run time, of the simulator and of the networks."""

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from itertools import chain

from jaxunshear.errors import UserError
from jaxunshear.storage import Json

Keep = Callable[[list[Json]], None]
OPTIONS: dict[str, tuple[str, ...]] = {
    "sim": ("level", "batch", "out"),
    "train": ("size", "batch"),
    "infer": ("size", "batch"),
    "needs": ("size",),
    "pins": ("size", "seed"),
    "stream": ("size",),
    "strangers": ("recordings", "seed"),
    "data": (),
    "input": (),
    "pinnets": (),
    "explore": (),
}


def run(arguments: argparse.Namespace, keep: Keep) -> int:
    taken = OPTIONS[arguments.what]
    for option in dict.fromkeys(chain.from_iterable(OPTIONS.values())):
        if getattr(arguments, option) is not None and option not in taken:
            known = " and ".join([", ".join(f"--{name}" for name in taken), "--json"] if taken else ["--json"])
            raise UserError(f"--{option}: bench {arguments.what} has no use for it; it takes {known}")
    if find_spec("jaxunshear.benchmarks") is None:
        raise UserError(
            "bench: benchmarks come with a checkout alone: clone the repository and `pip install -e .` there"
        )
    if arguments.batch is not None and arguments.batch < 1:
        raise UserError(f"--batch {arguments.batch}: use at least 1")
    if not taken:
        return _run_plain(arguments.what, keep)
    if arguments.what != "sim":
        return _run_networks(arguments, keep)
    from jaxunshear.benchmarks import bench_figure, bench_sim
    from jaxunshear.storage import write_bytes

    rows = bench_sim.bench_sim(arguments.level, arguments.batch, keep=keep)
    print(bench_sim.table(rows))
    if arguments.out is not None:
        write_bytes(arguments.out / "work_precision.png", bench_figure.work_precision(rows))
        print(arguments.out / "work_precision.png")
    return 0


def _run_plain(what: str, keep: Keep) -> int:
    """Of those that take no option."""
    from jaxunshear.benchmarks import bench_data, bench_explore, bench_input, bench_pin_networks
    from jaxunshear.table import plain_table

    kinds: dict[str, tuple[Callable[[], list[Json]], tuple[str, ...]]] = {
        "data": (bench_data.bench_data, bench_data.COLUMNS),
        "input": (bench_input.bench_input, bench_input.COLUMNS),
        "pinnets": (bench_pin_networks.bench_pin_networks, bench_pin_networks.COLUMNS),
        "explore": (bench_explore.bench_explore, bench_explore.COLUMNS),
    }
    measure, columns = kinds[what]
    rows = measure()
    print(plain_table(rows, columns))
    keep(rows)
    return 0


def _run_networks(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.benchmarks import bench_networks

    if arguments.size is not None and arguments.size < 1:
        raise UserError(f"--size {arguments.size}: use at least 1")
    if arguments.what == "needs":
        return _run_needs(arguments, keep)
    if arguments.what == "pins":
        return _run_pins(arguments, keep)
    if arguments.what == "strangers":
        return _run_strangers(arguments, keep)
    if arguments.what == "stream":
        rows = bench_networks.bench_stream(arguments.size)
    else:
        measure = bench_networks.bench_train if arguments.what == "train" else bench_networks.bench_infer
        rows = measure(arguments.size, arguments.batch)
    print(bench_networks.table(rows))
    keep(rows)
    return 0


def _run_needs(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.benchmarks import bench_needs

    rows = bench_needs.bench_needs(128 if arguments.size is None else arguments.size)
    print(bench_needs.table(rows))
    keep(rows)
    return 0


def _run_pins(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.benchmarks import bench_pins
    from jaxunshear.table import plain_table

    if arguments.size is not None and not 64 <= arguments.size <= 1024:
        raise UserError(f"--size {arguments.size}: use 64 to 1024 px")
    seed = 0 if arguments.seed is None else arguments.seed
    if seed < 0:
        raise UserError(f"--seed {seed}: use 0 or more")
    rows = bench_pins.bench_pins(arguments.size, seed)
    print(plain_table(rows, bench_pins.COLUMNS))
    keep(rows)
    return 0


def _run_strangers(arguments: argparse.Namespace, keep: Keep) -> int:
    from jaxunshear.benchmarks import confidence
    from jaxunshear.table import plain_table

    rows = confidence.bench(arguments.recordings or [], arguments.seed or 0)
    print(plain_table(rows, ("name", "images", "refused", "accepted", "low", "high", "auc")))
    keep(rows)
    return 0
