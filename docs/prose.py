"""Checks the prose of the pages: proselint, the length of sentences, and how they begin.

`make docs` runs it as `python -m docs.prose`; the exit code is 1 if it finds something.
"""

import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from proselint.checks import __register__
from proselint.registry import CheckRegistry
from proselint.tools import LintFile

ROOT = Path(__file__).resolve().parents[1]
MOST_WORDS = 25  # in a sentence; what is in brackets is not counted
# quotes and dots are typed as code has them; names of days and of folders are alike
LEFT_OUT = ("typography", "misc.capitalization")
BEGINNING = re.compile(r"(What|Of|Th(at|ose) of) ")  # of a sentence, to be written otherwise
HIDDEN = r"```.*?```|<sub>.*?</sub>|<!--.*?-->"  # no prose
SENTENCE_END = re.compile(r"(?<=[.?!;])[*)\"]*\s+(?=[\w\"(*`])")


def list_pages() -> list[Path]:
    """List the pages whose prose is checked."""
    tops = ROOT / "README.md", ROOT / "CONTRIBUTING.md"
    return [*tops, *sorted((ROOT / "docs").rglob("*.md"))]


def list_paragraphs(text: str) -> list[str]:
    """List the paragraphs and the points of a page, without headings, tables and code."""
    paragraphs, current = [], list[str]()
    for line in [*re.sub(HIDDEN, "", text, flags=re.DOTALL).splitlines(), ""]:
        point = re.match(r"\s*(?:[*-]|\d+\.) +(.*)", line)
        if point or not line.strip() or line.startswith(("|", "#", "!", ":::", "    ")):
            paragraphs.append(" ".join(current))
            current = [point[1]] if point else []
        else:
            current.append(line.strip())
    return [paragraph for paragraph in paragraphs if paragraph]


def strip_markup(paragraph: str) -> str:
    """Return a paragraph with the text of its links, and a letter for each piece of code."""
    linked = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", paragraph)
    return re.sub(r"`[^`]*`", "X", linked).replace("*", "")


@cache
def register_checks() -> None:
    """Register the checks of proselint, which knows none before."""
    CheckRegistry().register_many(__register__)


def find_problems(text: str) -> Iterator[str]:
    """Find what is wrong with the prose of a page, a line each."""
    register_checks()
    for paragraph in map(strip_markup, list_paragraphs(text)):
        for result in LintFile("page", paragraph).lint():
            check = result.check_result
            if not check.check_path.startswith(LEFT_OUT):
                yield f"{check.message} ({check.check_path}): {paragraph}"
        for sentence in SENTENCE_END.split(paragraph):
            words = re.findall(r"[\w%'-]+", re.sub(r"\([^()]*\)", "", sentence))
            if len(words) > MOST_WORDS:
                yield f"{len(words)} words, use at most {MOST_WORDS}: {sentence}"
            if BEGINNING.match(sentence):
                yield f"begins with {words[0]}: {sentence}"


def main() -> int:
    found = [
        f"{page.relative_to(ROOT)}: {problem}"
        for page in list_pages()
        for problem in find_problems(page.read_text())
    ]
    print("\n".join(found), file=sys.stderr, end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
