"""`python -m verification verify|stability|plan`."""

import sys

from jaxunshear.__main__ import run

if __name__ == "__main__":
    sys.exit(run("verification.commands"))
