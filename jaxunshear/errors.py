"""What is meant for people: an error, caught at the edge, printed as one line, exit code 2; and a note, which hinders nothing."""


class UserError(Exception):
    """What went wrong, where (file or field), and the remedy, in one line."""


class Note(UserWarning):
    """What works, but not as well as it could, in one line."""


def get_first_line(error: BaseException) -> str:
    """What an error of another library says, in one line of at most 200 characters; its kind where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
