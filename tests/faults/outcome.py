"""Outcomes of cases, and the rows that count them."""

import contextlib
import hashlib
import io
import random
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.cli import main
from jaxunshear.errors import Note, UserError

ERROR = "jaxunshear: error: "
EXAMPLES = 5


def run_command(*words: object) -> None:
    """Run a command in this process.

    Raises UserError if it ends with exit code 2 and one line, RuntimeError if with another but 0.
    """
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        code = main([str(word) for word in words])
    refusals = [line for line in err.getvalue().splitlines() if line.startswith(ERROR)]
    if code == 2 and len(refusals) == 1:
        raise UserError(refusals[0])
    if code:
        raise RuntimeError(f"exit code {code}: {refusals}")


def compute_digest(files: Iterable[Path]) -> str:
    """Compute a digest of the files' bytes."""
    return hashlib.sha256(b"".join(file.read_bytes() for file in sorted(files))).hexdigest()


def compute_array_digest(tree: object) -> str:
    """Compute a digest of arrays by name."""
    digest = hashlib.sha256()
    if isinstance(tree, dict):
        for name in sorted(tree):
            digest.update(f"{name} {compute_array_digest(tree[name])}".encode())
    else:
        array = np.asarray(tree)
        digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


@dataclass
class Row:
    """The cases of one fault and command.

    `lost`: work that a rerun did not bring back, or a crash without a line for people; `silent`:
    another result without a word.
    """

    fault: str
    command: str
    seed: int
    cases: int = 0
    harmless: int = 0
    refused: int = 0
    lost: int = 0
    silent: int = 0
    seconds: float = 0.0
    examples: list[str] = field(default_factory=list)  # of the lost and silent

    def count(self, kind: str, where: str = "") -> None:
        self.cases += 1
        setattr(self, kind, getattr(self, kind) + 1)
        if kind in ("lost", "silent") and len(self.examples) < EXAMPLES:
            self.examples.append(f"{kind}: {where}"[:300])


class Outcome(NamedTuple):
    """The outcome of a case: a count of `Row`, and where it was; None if nothing was tried."""

    kind: str | None
    where: str = ""


@dataclass(frozen=True)
class Size:
    """How much of the campaign to run."""

    seed: int
    bits: int  # flipped, of each kind of file
    writes: int  # that fail, of each command
    moments: int  # at which each command is killed
    cases: int  # of fuzz
    seconds: float  # that a row may take; the rest of its cases is left out


def run_cases(
    row: Row,
    size: Size,
    most: int,
    try_case: Callable[[random.Random], Outcome],
    tries: int | None = None,
) -> Row:
    """Try cases until `most` are counted, `tries` are made, or the time is over."""
    start, draw = time.monotonic(), random.Random(size.seed)
    for _ in range(tries or most):
        if row.cases >= most or time.monotonic() > start + size.seconds:
            break
        outcome = try_case(draw)
        if outcome.kind is not None:
            row.count(*outcome)
    row.seconds = time.monotonic() - start
    return row


def judge_reading(
    read: Callable[[], object], right: object, where: str, names: tuple[str, ...]
) -> Outcome:
    """Judge what reads a damaged file.

    It reads what is right, or refuses, or notes, in a line that has one of `names`; or is at fault.
    """
    try:
        with warnings.catch_warnings(record=True) as noted:
            warnings.simplefilter("always", Note)
            found = read()
    except UserError as error:
        named = "\n" not in str(error) and any(name in str(error) for name in names)
        return Outcome("refused" if named else "lost", f"{where}: {error}")
    except Exception as error:
        return Outcome("lost", f"{where}: {type(error).__name__}: {error}")
    said = " ".join(str(note.message) for note in noted if issubclass(note.category, Note))
    if found == right:
        return Outcome("harmless", where)
    return Outcome("refused" if any(name in said for name in names) else "silent", where)


def flip_bit(data: bytes, bit: int) -> bytes:
    array = np.frombuffer(data, np.uint8).copy()
    array[bit // 8] ^= np.uint8(1 << (bit % 8))
    return array.tobytes()
