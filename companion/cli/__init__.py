"""The command line `companion`.

Exit codes: 0 done; 1 failed or refused; 2 usage or configuration error (one line on stderr); 3 the daemon does not
answer, or `companion ground` finds no vehicle or companion on the link. With --json a command prints exactly one JSON
object on stdout, with `reason` after a failure; texts go to stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import re
import sys
from collections.abc import Sequence
from contextvars import copy_context
from functools import partial
from pathlib import Path
from typing import Final

from companion import __version__, config, messages
from companion.cli.terminal import (
    DONE,
    FAILED,
    NO_DAEMON,
    USAGE,
    Command,
    CommandGroup,
    DaemonRefusedError,
    Parser,
    as_typed,
    how_to_start,
    own_name,
    print_json,
    print_lines,
)
from companion.errors import CompanionError, ConfigError, DaemonDeniedError, DaemonUnreachableError, NobodyHeardError
from companion.links.system.process import OneLineFormatter

GROUPS: Final = {
    "every day": ("status", "calibrate", "fix", "cancel", "undo", "history", "report", "explain"),
    "set-up": ("setup", "check", "ports", "align", "autopilot", "page", "service"),
    "expert": ("run", "log", "ground", "fleet"),
}
"""Commands by group, in the order of `companion --help`."""


class _Overview(Parser):
    """Parser of the whole command line; its help lists the commands by group."""

    commands: CommandGroup

    def format_help(self) -> str:
        lines = ["companion: field self-calibration of gyro and accelerometer biases"]
        for title, names in GROUPS.items():
            lines += [f"{title}:", *(f"  {name:11}{self.commands[name].description}" for name in names)]
        lines += ["", "companion COMMAND --help describes a command. All take --json (one JSON object on stdout)."]
        lines += [f"companion -c FILE COMMAND (default: {config.DEFAULT_PATH}). companion --version."]
        return "\n".join([*lines, ""])


def main(arguments: Sequence[str] | None = None) -> int:
    return copy_context().run(_run, arguments)


def _run(arguments: Sequence[str] | None) -> int:
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(OneLineFormatter())
    try:
        options = _parser().parse_args(arguments, argparse.Namespace(json=False))
        command: Command = options.command
        names, own = "|".join(name for group in GROUPS.values() for name in group), own_name(options)
        as_typed.set(lambda line: re.sub(rf"\bcompanion (?=({names})\b)", lambda _: f"{own} ", line))
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


def _parser() -> _Overview:
    from companion.cli import client, ground, local, logs, profile

    # -c and --json may precede or follow the subcommand. SUPPRESS: the later parser must not reset them to defaults.
    common = Parser(add_help=False, argument_default=argparse.SUPPRESS)
    common.add_argument("-c", "--config", type=Path, metavar="FILE", help=f"default: {config.DEFAULT_PATH}")
    common.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    parser = _Overview(prog="companion", parents=[common])
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    commands = CommandGroup(parser, common, listed=False)
    log = commands.group("log", "record, replay, learn a noise profile, judge a flight")
    autopilot = commands.group("autopilot", "arming script, parameters and temperature curves of the autopilot")
    local.add_commands(commands, autopilot)
    client.add_commands(commands, autopilot, log)
    logs.add_commands(log)
    profile.add_commands(log)
    ground.add_ground(commands)
    ground.add_fleet(commands)
    commands.add("help", partial(_help, parser), "describe a command").add_argument(
        "words", nargs="*", metavar="COMMAND"
    )
    parser.commands = commands
    return parser


async def _help(parser: Parser, options: argparse.Namespace) -> int:
    parser.parse_args([*options.words, "--help"])
    return DONE
