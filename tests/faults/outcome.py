"""What becomes of a case, and the rows that count it."""

import contextlib
import hashlib
import io
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from jaxunshear.cli import main
from jaxunshear.errors import Note, UserError

ERROR = "jaxunshear: error: "
EXAMPLES = 5


class Answer(NamedTuple):
    """Of a command in this process."""

    code: int
    out: str
    refusals: list[str]  # lines on stderr that are errors


def call(*words: object) -> Answer:
    """Whatever a command raises, it raises here, too."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(word) for word in words])
    return Answer(
        code,
        out.getvalue(),
        [line for line in err.getvalue().splitlines() if line.startswith(ERROR)],
    )


def commanded(*words: object) -> str:
    """What it prints. Raises UserError where it ends with exit code 2 and one line; RuntimeError where with anything else but 0."""
    answer = call(*words)
    if answer.code == 2 and len(answer.refusals) == 1:
        raise UserError(answer.refusals[0])
    if answer.code:
        raise RuntimeError(f"exit code {answer.code}: {answer.refusals}")
    return answer.out


def digest(files: list[Path]) -> str:
    """Of the files' bytes."""
    found = hashlib.sha256()
    for file in sorted(files):
        found.update(file.read_bytes())
    return found.hexdigest()


@dataclass
class Row:
    """Cases of one fault and command. `lost`: work that a rerun did not bring back, or a crash without a line for people; `silent`: another
    result without a word."""

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


@dataclass(frozen=True)
class Size:
    """How much of the campaign to run."""

    seed: int
    bits: int  # flipped, of each kind of file
    writes: int  # that fail, of each command
    moments: int  # at which each command is killed
    cases: int  # of fuzz
    seconds: float  # that a row may take; the rest of its cases is left out

    def places(self, most: int) -> Iterator[int]:
        """Numbers below `most` until the time is over."""
        end = time.monotonic() + self.seconds
        for number in range(most):
            if time.monotonic() > end:
                return
            yield number


def attempt(
    row: Row, act: Callable[[], object], right: object, where: str, names: tuple[str, ...] = ()
) -> None:
    """Counts one case: `act` gives what is right, refuses or notes in a line that has one of `names`, or is at fault."""
    try:
        with warnings.catch_warnings(record=True) as noted:
            warnings.simplefilter("always", Note)
            found = act()
    except UserError as error:
        named = not names or any(name in str(error) for name in names)
        row.count("refused" if named and "\n" not in str(error) else "lost", f"{where}: {error}")
    except Exception as error:
        row.count("lost", f"{where}: {type(error).__name__}: {error}")
    else:
        said = " ".join(str(note.message) for note in noted if issubclass(note.category, Note))
        named = any(name in said for name in names)
        row.count("harmless" if found == right else "refused" if named else "silent", where)
