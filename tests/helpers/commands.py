"""Commands of tests."""


def succeed(command, *words):
    """Call a command line that must succeed, and return its answer."""
    answer = command(*words)
    assert answer.code == 0, answer.err
    return answer
