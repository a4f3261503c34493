"""`python -m sim`: devices, autopilot, all, demo, ardupilot, px4, residuals, turntable, flights, ..."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["demo"]:
        try:
            demo = importlib.import_module("sim.demo")
        except ModuleNotFoundError as error:
            if error.name != "sim.demo":
                raise
            print("python -m sim demo: not part of this copy; try `python -m sim all`", file=sys.stderr)
            return 1
        return int(demo.main(arguments[1:]) or 0)
    if arguments[:1] == ["turntable"]:
        from sim.experiments.turntable import main as turntable

        return turntable(arguments[1:])
    if arguments[:1] == ["accuracy"]:
        from sim.accuracy.cli import main as accuracy

        return accuracy(arguments[1:])
    if arguments[:1] == ["rest"]:
        from sim.experiments.rest import main as rest

        return rest(arguments[1:])
    if arguments[:1] in (["drive"], ["flights"]):
        from sim.experiments.journeys import main as journeys

        return journeys(arguments)
    if arguments[:1] == ["fly"]:
        from sim.flying.cli import main as fly

        return fly(arguments[1:])
    from sim.serve import FIRMWARE_COMMANDS
    from sim.serve import main as serve

    if arguments[:1] and arguments[0] in FIRMWARE_COMMANDS:
        from sim.sitl.cli import main as firmware

        return firmware(arguments)
    return serve(arguments)


if __name__ == "__main__":
    sys.exit(main())
