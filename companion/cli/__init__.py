"""The command line `companion`.

Exit codes: 0 done; 1 failed or refused; 2 usage or configuration error (one line on stderr); 3 the daemon does not
answer, or `companion ground` finds no vehicle or companion on the link. With --json a command prints exactly one JSON
object on stdout, with `reason` after a failure; texts go to stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from companion import __version__, config, messages
from companion.cli.terminal import (
    FAILED,
    NO_DAEMON,
    USAGE,
    Command,
    DaemonRefusedError,
    Parser,
    adder,
    how_to_start,
    print_json,
    print_lines,
)
from companion.errors import CompanionError, ConfigError, DaemonDeniedError, DaemonUnreachableError, NobodyHeardError
from companion.links.system.process import OneLineFormatter


def main(arguments: Sequence[str] | None = None) -> int:
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(OneLineFormatter())
    try:
        options = _parser().parse_args(arguments, argparse.Namespace(json=False))
        command: Command = options.command
        return asyncio.run(command(options))
    except ConfigError as error:
        print_lines(error, error=True)
        return USAGE
    except (DaemonUnreachableError, NobodyHeardError) as error:
        # No hint to start the daemon if it denies access, as it runs; nor on the ground, as it runs on the aircraft.
        starts = "" if isinstance(error, DaemonDeniedError | NobodyHeardError) else how_to_start(options)
        _fail(options, "unreachable", str(error) + starts)
        return NO_DAEMON
    except CompanionError as error:
        _fail(options, "refused" if isinstance(error, DaemonRefusedError) else "failed", str(error))
        return FAILED
    except KeyboardInterrupt:
        return FAILED
    except BrokenPipeError:
        # The program that reads our output has ended (| head): print no error.
        sys.stderr.close()
        return FAILED


def _fail(options: argparse.Namespace, state: str, reason: str) -> None:
    print_lines(f"companion: {reason}", error=True)
    if state != "failed" and (remedy := messages.remedy(reason)):  # errors of offline tools contain their remedy
        print_lines(f"-> {remedy}", error=True)
    if options.json:
        print_json({"state": state, "reason": reason})


def _parser() -> Parser:
    from companion.cli import client, desk, ground, local, profile

    # -c and --json may precede or follow the subcommand. SUPPRESS: the later parser must not reset them to defaults.
    common = Parser(add_help=False, argument_default=argparse.SUPPRESS)
    common.add_argument("-c", "--config", type=Path, metavar="FILE", help=f"default: {config.DEFAULT_PATH}")
    common.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    parser = Parser(
        prog="companion", parents=[common], description="Field self-calibration of gyro and accelerometer biases."
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    subcommands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    add = adder(subcommands, common)
    for module in (local, client, desk, profile):
        module.add_commands(add)
    ground.add_ground(subcommands, common)
    ground.add_fleet(subcommands, common)
    return parser
