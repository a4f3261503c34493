"""Run a subcommand of `python -m sim`."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from typing import Final

MODULES: Final = {
    "demo": "sim.demo",
    "fleet": "sim.fleet.demo",
    "accuracy": "sim.accuracy.cli",
    "recordings": "sim.accuracy.recordings",
    "rest": "sim.rest",
    "fly": "sim.flying.cli",
}
"""Modules by command. Their `main` receives the arguments after the command; in all other modules, the command too."""


def main(argv: Sequence[str] | None = None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = arguments[0] if arguments else ""
    if command in MODULES:
        return int(importlib.import_module(MODULES[command]).main(arguments[1:]) or 0)
    from sim.serve import FIRMWARE_COMMANDS
    from sim.serve import main as run

    if command in FIRMWARE_COMMANDS:
        from sim.sitl.cli import main as run
    return run(arguments)


if __name__ == "__main__":
    sys.exit(main())
