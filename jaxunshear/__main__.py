"""`python -m jaxunshear`."""

import sys

from jaxunshear.cli import main

sys.exit(main())
