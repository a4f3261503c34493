"""Entry point of `python -m companion`, which runs the command line."""

import sys

from companion.cli import main

sys.exit(main())
