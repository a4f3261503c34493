"""The command line.

Exit codes of every command: 0 done, 1 failed or refused (the reason in `reason`), 2 usage or configuration error
(one line on stderr), 3 no daemon answers (from the
ground: no vehicle or no companion is heard). With --json stdout holds exactly one JSON object; words go to stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from companion import __version__, commands, config
from companion.cli.terminal import (
    FAILED,
    NO_DAEMON,
    USAGE,
    Command,
    Parser,
    add_fields,
    adder,
    how_to_start,
    print_json,
    print_lines,
    seconds,
)
from companion.errors import CompanionError, ConfigError, DaemonDeniedError, DaemonUnreachableError, NobodyHeardError
from companion.links.system.process import OneLineFormatter


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(OneLineFormatter())
    try:
        options = _parser().parse_args(arguments, argparse.Namespace(json=False))
        return asyncio.run(_run(options))
    except ConfigError as error:
        print_lines(error, error=True)
        return USAGE
    except (DaemonUnreachableError, NobodyHeardError) as error:
        # Who may not ask it need not start it, and from the ground nobody can.
        starts = "" if isinstance(error, DaemonDeniedError | NobodyHeardError) else how_to_start(options)
        _fail(options, "unreachable", str(error) + starts)
        return NO_DAEMON
    except CompanionError as error:
        _fail(options, "failed", str(error))
        return FAILED
    except KeyboardInterrupt:
        return FAILED
    except BrokenPipeError:
        # The reader of our output is gone (| head): nothing is left to say, and nobody to say it to.
        sys.stderr.close()
        return FAILED


async def _run(options: argparse.Namespace) -> int:
    command: Command = options.command
    return await command(options)


def _fail(options: argparse.Namespace, state: str, reason: str) -> None:
    print_lines(f"companion: {reason}", error=True)
    if options.json:
        print_json({"state": state, "reason": reason})


def _parser() -> Parser:
    from companion.cli import client, desk, ground, local, monitor, profile

    # -c and --json may stand before or after the subcommand: SUPPRESS keeps the later parser from undoing the first.
    common = Parser(add_help=False, argument_default=argparse.SUPPRESS)
    common.add_argument("-c", "--config", type=Path, metavar="FILE", help=f"default: {config.DEFAULT_PATH}")
    common.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    parser = Parser(
        prog="companion", parents=[common], description="Field self-calibration of gyro and accelerometer biases."
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    subcommands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    add = adder(subcommands, common)
    local.add_command(add)
    run = add("run", local.run, "run the daemon in the foreground")
    run.add_argument("-v", "--verbose", action="store_true", help="log what happens in detail")
    check = add("check", local.check, "check configuration, ports, sensors and autopilot; say what is wrong")
    check.add_argument("--seconds", type=seconds, default=3.0, metavar="S", help="how long to listen (default 3)")
    ports = add("ports", local.ports, "list serial ports with their stable names")
    words = "tell who speaks on these ports (default: all that nobody holds and no console uses) by listening at the"
    words += " usual speeds, up to half a minute; not a byte is sent, but opening a port raises DTR, which starts an"
    ports.add_argument("--listen", nargs="*", metavar="PORT", help=f"{words} Arduino anew")
    words = "print the arming script for ArduPilot (> APM/scripts/companion_arming.lua), and how to install it"
    add("lua", local.lua, words)
    local.add_commands(add)
    for kind, command in (
        (commands.Status, client.status),
        (commands.Calibrate, client.calibrate),
        (commands.Align, client.align),
        (commands.Cancel, client.cancel),
        (commands.Undo, client.undo),
        (commands.AutopilotSetup, client.setup),
        (commands.History, client.history),
        (commands.Temperature, client.temperature),
        (commands.Monitor, monitor.monitor),
        (commands.RecordInputs, client.record),
    ):
        add_fields(add(kind.name(), command, kind.help), kind, commands.Interface.COMMAND_LINE)
    add("web-token", local.web_token, "where the page is, and the token that its buttons need")
    desk.add_commands(add)
    profile.add_command(add)
    ground.add_ground(subcommands, common)
    ground.add_fleet(subcommands, common)
    return parser
