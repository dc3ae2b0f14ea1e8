"""Pages are in plain English, as far as a program can see."""

import pytest

from docs.prose import MOST_WORDS, ROOT, find_problems, list_pages, list_paragraphs


@pytest.mark.parametrize("page", [page.relative_to(ROOT).as_posix() for page in list_pages()])
def test_the_prose_of_pages_is_plain(page):
    assert not list(find_problems((ROOT / page).read_text()))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("It is very large.", "weasel_words"),
        ("The pins of the the dome move.", "lexical_illusions"),
        ("* " + " ".join(f"w{i}" for i in range(MOST_WORDS + 1)), f"{MOST_WORDS + 1} words"),
        ("A pin moves. What it does is\nunknown.", "begins with What"),
    ],
)
def test_a_habit_is_noticed(text, problem):
    (found,) = find_problems(text)
    assert problem in found


def test_only_prose_is_checked():
    words = "very " * 2 * MOST_WORDS
    text = f"# {words}\n\n| {words} |\n\n    {words}\n\n```python\n{words}\n```\n\n`{words}`\n"
    assert not list(find_problems(text))
    assert list_paragraphs("One\nline.\n\n1. A point\n   of two.\n") == [
        "One line.",
        "A point of two.",
    ]
