"""The daemon's process: `python -m companion.daemon FILE [-v]`. `companion run` turns into it."""

import sys

from companion.daemon.process import footprint

if __name__ == "__main__":
    # Before asyncio and numpy are loaded.
    footprint.prepare()
    from companion.daemon.process.supervisor import main

    sys.exit(main(*sys.argv[1:]))
