"""Selects what a command runs by words of its names."""

import difflib
import re
from collections import Counter
from collections.abc import Sequence

from jaxunshear.errors import UserError

MAX_LISTED = 40  # names; of more than these the most frequent words are listed
LISTED_WORDS = 8


def select_names(names: Sequence[str], only: Sequence[str]) -> list[str]:
    """Select the names that contain one of the words `only`; all names if there is no word.

    Raises UserError for a word that no name contains.
    """
    for word in only:
        if not any(word in name for name in names):
            raise UserError(f"--only '{word}': no name contains this{_suggest(word, names)}")
    return [name for name in names if not only or any(word in name for word in only)]


def _suggest(word: str, names: Sequence[str]) -> str:
    words: Counter[str] = Counter()
    for name in names:
        words.update(set(re.findall(r"[A-Za-z][A-Za-z0-9]{3,}", name)))
    near = difflib.get_close_matches(word, [*words, *names], n=3)
    hint = f"; did you mean {' or '.join(near)}?" if near else ";"
    if len(names) <= MAX_LISTED:
        return f"{hint} the names are {', '.join(names)}"
    return f"{hint} many contain {', '.join(each for each, _ in words.most_common(LISTED_WORDS))}"
