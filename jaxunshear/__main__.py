"""`jaxunshear` and `python -m jaxunshear`."""

import sys

from jaxunshear.memory import restart_with_large_pages


def run() -> int:
    """One command, in a process of its own."""
    restart_with_large_pages()
    from jaxunshear.cli import main

    return main()


if __name__ == "__main__":
    sys.exit(run())
