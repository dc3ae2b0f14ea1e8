"""Event files of TensorBoard beside a training's log, if the extra `tensorboard` is installed."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import optax

from jaxunshear.files import Json

GROUPS = ("train", "validation", "kernels")  # of a line of log.jsonl


@contextlib.contextmanager
def open_events(folder: Path, step: int, rate: optax.Schedule) -> Iterator[Callable[[Json], None]]:
    """Open an event file in `folder`; yield a function that appends a line of the log to it.

    TensorBoard then drops what a stopped process wrote beyond `step`. `rate` returns the learning
    rate of a step from 0. Without tensorboardX nothing is written.
    """
    try:
        # EventsWriter writes at once: no thread can fail unnoticed
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog
        from tensorboardX.proto.summary_pb2 import Summary
    except ImportError:
        yield lambda line: None
        return

    def append(line: Json) -> None:
        values = list_scalars(line) | {"learning_rate": float(rate(line["step"] - 1))}
        summary = Summary(
            value=[Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()]
        )
        writer.write_event(Event(wall_time=time.time(), step=line["step"], summary=summary))
        writer.flush()

    with contextlib.closing(EventsWriter(str(folder / "events"))) as writer:
        start = SessionLog(status=SessionLog.START)
        writer.write_event(Event(wall_time=time.time(), step=step + 1, session_log=start))
        yield append


def list_scalars(line: Json) -> dict[str, float]:
    """Return the known figures of a line of log.jsonl by tag."""
    return {
        f"{group}/{name}": float(value)
        for group in GROUPS
        for name, value in (line.get(group) or {}).items()
        if value is not None
    }
