"""Commands for papers: score results of other methods, list a frozen split, cite."""

import argparse
import sys
from pathlib import Path

from jaxunshear import __version__
from jaxunshear.cli.models import choose_exit_code
from jaxunshear.cli.program import (
    ROWS,
    define_command,
    json_file,
    option,
    path,
    write_measurement,
)
from jaxunshear.config.data import FROZEN_SPLITS
from jaxunshear.config.splits import SPLITS
from jaxunshear.errors import UserError
from jaxunshear.files import format_csv, write_text
from jaxunshear.output_checks import check_new_file, check_not_among

SHOWN_NOTES = 5
CITATIONS = Path(__file__).parents[1] / "citations.bib"
SPLIT_NAMES = {"metavar": "NAME", "choices": FROZEN_SPLITS}


@define_command(
    "score unsheared images, or poses, of another method on recorded slides",
    path("path", "RESULTS", "a folder of images named as the slides, or poses as CSV or npz"),
    path("--recordings", "RECORDINGS", "labelled slides, and taps at their poses", required=True),
    ("--split", SPLIT_NAMES | {"help": "score the test slides of this frozen split alone"}),
    json_file(ROWS),
)
def score(arguments: argparse.Namespace, command: str) -> int:
    """Print the scores of a submission; return 1 if half of the slides or more are left out."""
    from jaxunshear.evaluation.submissions import format_rows, score_submission
    from jaxunshear.text_table import format_text_table

    if not arguments.path.exists():
        raise UserError(
            f"{arguments.path} does not exist: name a folder of images, a CSV or an npz"
        )
    submission = score_submission(arguments.path, arguments.recordings, arguments.split)
    print(format_text_table(format_rows(submission.rows), submission.columns))
    for reason, count in submission.left_out.items():
        if count:
            print(f"left out {count}: {reason}")
    for note in submission.notes[:SHOWN_NOTES]:
        print(f"note: {note}", file=sys.stderr)
    content = {"rows": submission.rows, "left_out": submission.left_out}
    write_measurement(arguments.json, command, content)
    return choose_exit_code(submission.scored, submission.slides - submission.scored)


@define_command(
    "check a public set that you downloaded, and list the rows of its frozen split",
    ("name", SPLIT_NAMES | {"help": f"the public set: {', '.join(FROZEN_SPLITS)}"}),
    path("--recordings", "RECORDINGS", "folder of your download", required=True),
    path("--out", "FILE", "CSV of the contacts, each with its split"),
    computes=False,
)
def split(arguments: argparse.Namespace, command: str) -> int:
    """Check recordings against a frozen split; return 1 if their images are not the same."""
    from jaxunshear.data.public_sets import check_public_set

    if arguments.out:
        check_new_file(arguments.out, "--out")
        check_not_among(arguments.recordings, arguments.out.parent, "--out")
    checked = check_public_set(arguments.name, arguments.recordings)
    if arguments.out:
        write_text(arguments.out, format_csv(checked.rows))
    for kind, part in checked.kinds.items():
        counts = ", ".join(f"{part.counts[split]} {split}" for split in SPLITS)
        images = "as in the public set" if part.has_same_images else "not as in the public set"
        print(f"{kind}s: {counts}; labels as in the public set, images {images}")
    return 0 if all(part.has_same_images for part in checked.kinds.values()) else 1


@define_command(
    "print the BibTeX of this software, the paper that it follows, and the public recordings",
    option("name", "NAME", "print this entry alone (default: all)", nargs="?"),
    computes=False,
)
def cite(arguments: argparse.Namespace, command: str) -> int:
    """Print the BibTeX of the software, the paper and the public recordings, or of one of them."""
    text = CITATIONS.read_text().replace("VERSION", __version__)
    entries = {
        entry[entry.index("{") + 1 : entry.index(",")]: entry for entry in text.split("\n\n")
    }
    name = arguments.name
    if name is not None and name not in entries:
        raise UserError(f"there is no citation '{name}': use one of {', '.join(entries)}")
    print((text if name is None else entries[name]).strip())
    return 0


COMMANDS = (score, split, cite)
