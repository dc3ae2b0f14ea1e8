"""`check bench`: error against run time, of the simulator and of the networks."""

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from itertools import chain

from jaxunshear.errors import UserError
from jaxunshear.storage import Json

Keep = Callable[[list[Json]], None]
Found = tuple[list[Json], str]  # rows, and what is printed of them
OPTIONS: dict[str, tuple[str, ...]] = {
    "sim": ("level", "batch", "out"),
    "train": ("size", "batch"),
    "infer": ("size", "batch"),
    "needs": ("size",),
    "pins": ("size", "seed"),
    "stream": ("size",),
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
    for option in ("batch", "size"):
        value = getattr(arguments, option)
        if value is not None and value < 1:
            raise UserError(f"--{option} {value}: use at least 1")
    rows, text = _MEASURES.get(arguments.what, _plain)(arguments, keep)
    print(text)
    keep(rows)
    return 0


def _sim(arguments: argparse.Namespace, keep: Keep) -> Found:
    from jaxunshear.benchmarks import bench_figure, bench_sim
    from jaxunshear.storage import write_bytes

    rows = bench_sim.bench_sim(arguments.level, arguments.batch, keep=keep)
    text = bench_sim.table(rows)
    if arguments.out is not None:
        figure = arguments.out / "work_precision.png"
        write_bytes(figure, bench_figure.work_precision(rows))
        text += f"\n{figure}"
    return rows, text


def _networks(arguments: argparse.Namespace, keep: Keep) -> Found:
    from jaxunshear.benchmarks import bench_networks

    if arguments.what == "stream":
        rows = bench_networks.bench_stream(arguments.size)
    else:
        measure = bench_networks.bench_train if arguments.what == "train" else bench_networks.bench_infer
        rows = measure(arguments.size, arguments.batch)
    return rows, bench_networks.table(rows)


def _needs(arguments: argparse.Namespace, keep: Keep) -> Found:
    from jaxunshear.benchmarks import bench_needs

    rows = bench_needs.bench_needs(arguments.size or 128)
    return rows, bench_needs.table(rows)


def _pins(arguments: argparse.Namespace, keep: Keep) -> Found:
    from jaxunshear.benchmarks import bench_pins
    from jaxunshear.table import plain_table

    if arguments.size is not None and not 64 <= arguments.size <= 1024:
        raise UserError(f"--size {arguments.size}: use 64 to 1024 px")
    seed = arguments.seed or 0
    if seed < 0:
        raise UserError(f"--seed {seed}: use 0 or more")
    rows = bench_pins.bench_pins(arguments.size, seed)
    return rows, plain_table(rows, bench_pins.COLUMNS)


def _plain(arguments: argparse.Namespace, keep: Keep) -> Found:
    """Of those that take no option."""
    from jaxunshear.benchmarks import bench_data, bench_explore, bench_input, bench_pin_networks
    from jaxunshear.table import plain_table

    kinds: dict[str, tuple[Callable[[], list[Json]], tuple[str, ...]]] = {
        "data": (bench_data.bench_data, bench_data.COLUMNS),
        "input": (bench_input.bench_input, bench_input.COLUMNS),
        "pinnets": (bench_pin_networks.bench_pin_networks, bench_pin_networks.COLUMNS),
        "explore": (bench_explore.bench_explore, bench_explore.COLUMNS),
    }
    measure, columns = kinds[arguments.what]
    rows = measure()
    return rows, plain_table(rows, columns)


_MEASURES = {
    "sim": _sim,
    "train": _networks,
    "infer": _networks,
    "stream": _networks,
    "needs": _needs,
    "pins": _pins,
}
