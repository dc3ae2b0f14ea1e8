"""Puts a result into docs/results as its program wrote it: `python -m docs.keep NAME FILE`, or of
several runs in one file `python -m docs.keep NAME 'standard, seed 0=FILE' 'standard, seed 1=FILE'`.
Nothing in it is edited, its command least of all.

A result that cannot be published is refused: one without a checksum or a commit, of code that was
not committed, or that names a path of one machine.
"""

import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from docs.provenance import RESULTS, sources
from jaxunshear.errors import UserError
from jaxunshear.files import CHECKSUM_FIELD, Json, read_object, write_json

PLACE = re.compile(r"(?:^|[\s'=])/\w[\w.-]*/")


def keep(name: str, files: Sequence[str], folder: Path = RESULTS) -> Path:
    """Write folder/<name>.json: FILE itself, or the files by label. Raises UserError."""
    out = folder / f"{name}.json"
    labelled = {label: Path(file) for label, _, file in (each.rpartition("=") for each in files)}
    if len(labelled) < len(files) or ("" in labelled and len(files) > 1):
        raise UserError("several files need labels, each its own: LABEL=FILE LABEL=FILE")
    held = {label: _publishable(path) for label, path in labelled.items()}
    write_json(out, held.get("", {"runs": held}))
    return out


def _publishable(path: Path) -> Json:
    held = read_object(path)
    if CHECKSUM_FIELD not in json.loads(path.read_text()):
        raise UserError(
            f"{path} bears no {CHECKSUM_FIELD}: it was edited, or is older than checksums; make it again"
        )
    made = sources(held)
    if not made or any(source.commit is None or not source.clean for source in made):
        raise UserError(f"{path} was made with code that no commit has: commit, then make it again")
    if place := next(filter(PLACE.search, _texts(held)), None):
        raise UserError(
            f"{path} names a place of one machine, {place}: make it again with paths from where you stand"
        )
    return held


def _texts(held: object) -> Iterator[str]:
    if isinstance(held, str):
        yield held
    elif isinstance(held, dict | list):
        for each in held.values() if isinstance(held, dict) else held:
            yield from _texts(each)


if __name__ == "__main__":
    try:
        print(keep(sys.argv[1], sys.argv[2:]))
    except (UserError, IndexError) as error:
        sys.exit(str(error) if isinstance(error, UserError) else __doc__)
