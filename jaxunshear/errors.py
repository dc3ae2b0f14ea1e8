"""Errors and notes for people.

The command line prints either as one line; an error ends the command with exit code 2.
"""

import re

# addresses of objects in messages of libraries, which are others in each process
_ADDRESS = re.compile(r" <_io\.\w+ object at \w+>| at 0x[0-9a-f]+")


class UserError(Exception):
    """An error that says in one line what went wrong, where (file or field), and the remedy."""

    def __str__(self) -> str:
        return _ADDRESS.sub("", super().__str__())


class Note(UserWarning):
    """A warning about what works, but not as well as it could, in one line."""


def get_first_line(error: BaseException) -> str:
    """Return the first 200 characters of an error's first line, or its type if it has no text."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
