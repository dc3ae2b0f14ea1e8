"""Frames from other programs: on stdin, over TCP, or over ZeroMQ.

A frame is an image in a file's form (PNG, JPEG, or numpy's NPY). On stdin and over TCP a HEADER
comes before each: its length, and when it was taken, s since 1970, or NaN for now. Over ZeroMQ it
is a message of its own, with the time in a part before it (TIME), or without.

>>> sys.stdout.buffer.write(HEADER.pack(len(png), time.time()) + png)        # of the other program
"""

import io
import math
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxunshear.apps.robot.source_frame import SourceFrame, SourceLostError
from jaxunshear.data.recordings import read_image
from jaxunshear.errors import UserError, get_first_line

HEADER = struct.Struct("!Id")
TIME = struct.Struct("!d")
MAX_BYTES = 1 << 28  # of an image; more is no length
NPY = b"\x93NUMPY"
POLL_MS = 100
FORM = "each frame is struct.pack('!Id', length, time) and an image of that length"


def read_messages(read: Callable[[int], bytes], name: str) -> Iterator[SourceFrame]:
    """Yield frames until `read(count)` gives no more bytes.

    Raises SourceLostError if they end within a frame, and UserError for bytes of another form.
    """
    number = 0
    while head := read(HEADER.size):
        length, time_s = HEADER.unpack(head) if len(head) == HEADER.size else (1, 0.0)
        if not 0 < length <= MAX_BYTES:
            raise UserError(f"{name}: frame {number} has {length} bytes: {FORM}")
        data = read(length)
        if len(head) < HEADER.size or len(data) < length:
            raise SourceLostError(f"{name} breaks off within frame {number}: {FORM}")
        yield _decode(number, name, data, time_s)
        number += 1


def read_tcp(address: str) -> Iterator[SourceFrame]:
    """Connect to host:port and yield its frames until it closes. Raises UserError."""
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 1 << 16):
        raise UserError(f"tcp://{address}: use tcp://HOST:PORT, with a port of 1 to 65535")

    def read_all() -> Iterator[SourceFrame]:
        try:
            with socket.create_connection((host.strip("[]"), int(port))) as connection:
                yield from read_messages(connection.makefile("rb").read, f"tcp://{address}")
        except OSError as error:
            raise UserError(f"tcp://{address}: {get_first_line(error)}") from None

    return read_all()


def read_zmq(endpoint: str) -> Iterator[SourceFrame | None]:
    """Subscribe to an endpoint and yield its frames, and None while there are none.

    Raises UserError if pyzmq is missing, or the endpoint is none.
    """
    try:
        import zmq
    except ImportError:
        raise UserError(
            "ZeroMQ needs the extra `zmq`: pip install -c constraints.txt '.[zmq]'"
        ) from None
    subscriber: Any = zmq.Context.instance().socket(zmq.SUB)
    try:
        subscriber.subscribe(b"")
        subscriber.connect(endpoint)
    except zmq.ZMQError as error:
        subscriber.close(0)
        raise UserError(f"zmq:{endpoint}: {error}; use zmq:tcp://HOST:PORT") from None

    def read_all() -> Iterator[SourceFrame | None]:
        number = 0
        try:
            while True:
                if not subscriber.poll(POLL_MS):
                    yield None
                    continue
                *heads, data = subscriber.recv_multipart()
                has_time = heads and len(heads[-1]) == TIME.size
                time_s = TIME.unpack(heads[-1])[0] if has_time else math.nan
                yield _decode(number, f"zmq:{endpoint}", data, time_s)
                number += 1
        finally:
            subscriber.close(0)

    return read_all()


def _decode(number: int, name: str, data: bytes, time_s: float) -> SourceFrame:
    frame = SourceFrame(number, f"{name} {number}", None)
    frame = frame._replace(time_s=time_s if math.isfinite(time_s) else time.time())
    try:
        if data.startswith(NPY):
            return frame._replace(pixels=np.load(io.BytesIO(data)))
        return frame._replace(pixels=read_image(data))
    except Exception as error:  # broken bytes meet errors of every kind
        return frame._replace(problem=f"this frame is no image: {get_first_line(error)}")
