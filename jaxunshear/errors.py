"""The one error meant for people: caught at the edge, printed as one line, exit code 2."""


class UserError(Exception):
    """What went wrong, where (file or field), and the remedy, in one line."""
