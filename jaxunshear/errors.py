"""Errors and notes for people.

The command line prints either as one line; an error ends the command with exit code 2.
"""


class UserError(Exception):
    """An error that says in one line what went wrong, where (file or field), and the remedy."""


class Note(UserWarning):
    """A warning about what works, but not as well as it could, in one line."""


def get_first_line(error: BaseException) -> str:
    """Return the first 200 characters of an error's first line, or its type if it has no text."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
