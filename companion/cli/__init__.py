"""The command line.

Exit codes of every command: 0 done, 1 failed or refused (the reason in `reason`), 2 usage or configuration error
(one line on stderr), 3 no daemon answers (from the
ground: no vehicle or no companion is heard). With --json stdout holds exactly one JSON object; words go to stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import sys
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

from companion import __version__, config
from companion.cli import logs
from companion.config.profiles import SavedProfiles
from companion.errors import CompanionError, ConfigError, DaemonUnreachableError, NobodyHeardError
from companion.printable import printable

DONE: Final = 0
FAILED: Final = 1
USAGE: Final = 2
NO_DAEMON: Final = 3

Command = Callable[[argparse.Namespace], Awaitable[int]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(logs.OneLineFormatter())
    options = _parser().parse_args(arguments)
    try:
        return asyncio.run(_dispatch(options))
    except ConfigError as error:
        print_lines(error, error=True)
        return USAGE
    except (DaemonUnreachableError, NobodyHeardError) as error:
        _fail(options, "unreachable", str(error))
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


async def _dispatch(options: argparse.Namespace) -> int:
    command: Command = options.command
    return await command(options)


def print_lines(*lines: object, error: bool = False, end: str = "\n") -> None:
    """Print lines for people, or JSON: the one door to the terminal, by which nothing goes that it would obey.

    Args:
        lines: each is one, whatever is in it.
        error: to stderr.
        end: of each.
    """
    stream = sys.stderr if error else sys.stdout
    for line in lines:
        stream.write(printable(str(line)) + end)
    stream.flush()


def _fail(options: argparse.Namespace, state: str, reason: str) -> None:
    print_lines(f"companion: {reason}", error=True)
    if getattr(options, "json", False):
        print_json({"state": state, "reason": reason})


def load_config(options: argparse.Namespace, *, profiles: bool = False, forgiving: bool = False) -> config.Config:
    """The configuration that -c names, or the default one.

    Args:
        options: of the command line.
        profiles: read the saved noise profiles that it names too; who only asks the daemon may not be allowed to, and
            leaves them be.
        forgiving: one of them that is damaged is no reason to refuse the configuration.
    """

    def saved(directory: Path) -> SavedProfiles | None:
        from companion.storage.profiles import ProfileStore

        return ProfileStore(directory, forgiving=forgiving) if profiles else None

    return config.load(config_path(options), saved)


def storage_path(options: argparse.Namespace) -> Path:
    """The storage directory of the configuration; where none is named and the default one is not there, the usual one.

    Raises:
        ConfigError: the configuration that -c names cannot be read.
    """
    try:
        return load_config(options).storage.path
    except ConfigError:
        if hasattr(options, "config"):
            raise
        return config.Storage().path


def config_path(options: argparse.Namespace) -> Path:
    """The file that -c names, or the default one."""
    path: Path = getattr(options, "config", config.DEFAULT_PATH)
    return path


class Parser(argparse.ArgumentParser):
    """Says a usage error in one line."""

    def error(self, message: str) -> NoReturn:
        """Say a usage error in one line."""
        print_lines(f"{self.prog}: {message} (see {self.prog} --help)", error=True)
        self.exit(USAGE)


def _parser() -> Parser:
    from companion.cli import align, client, ground, install, local, monitor, profile, recordings, report, setup

    # -c and --json may stand before or after the subcommand: SUPPRESS keeps the later parser from undoing the first.
    common = Parser(add_help=False, argument_default=argparse.SUPPRESS)
    common.add_argument("-c", "--config", type=Path, metavar="FILE", help=f"default: {config.DEFAULT_PATH}")
    common.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    parser = Parser(
        prog="companion", parents=[common], description="Field self-calibration of gyro and accelerometer biases."
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(name: str, command: Command, words: str) -> Parser:
        sub = commands.add_parser(name, parents=[common], help=words, description=words)
        sub.set_defaults(command=command)
        return sub

    run = add("run", local.run, "run the daemon in the foreground")
    run.add_argument("-v", "--verbose", action="store_true", help="log what happens in detail")
    check = add("check", local.check, "check configuration, ports, sensors and autopilot; say what is wrong")
    check.add_argument("--seconds", type=seconds, default=3.0, metavar="S", help="how long to listen (default 3)")
    ports = add("ports", local.ports, "list serial ports with their stable names")
    ports.add_argument(
        "--listen",
        nargs="*",
        metavar="PORT",
        help="tell who speaks on these ports (default: all that nobody holds and no console uses) by listening at the"
        " usual speeds, up to half a minute; not a byte is sent, but opening a port raises DTR, which starts an Arduino"
        " anew",
    )
    add(
        "lua",
        local.lua,
        "print the arming script for ArduPilot (> APM/scripts/companion_arming.lua), and how to install it",
    )
    install.add_commands(add)
    add("status", client.status, "what the daemon is doing")
    calibrate = add("calibrate", client.calibrate, "calibrate now (the aircraft must be disarmed and still)")
    what = calibrate.add_mutually_exclusive_group()
    what.add_argument("--gyros", action="store_true", help="gyros only")
    what.add_argument("--accelerometers", action="store_true", help="accelerometers only")
    calibrate.add_argument("--wait", action="store_true", help="wait for the end, show progress, print the record")
    calibrate.add_argument(
        "--timeout", type=seconds, metavar="S", help="cancel when it has not finished by then (default: no limit)"
    )
    calibrate.add_argument(
        "--reboot", action="store_true", help="restart the autopilot afterwards (PX4's attitude needs it)"
    )
    align.add_command(add)
    add("cancel", client.cancel, "cancel a running calibration")
    undo = add("undo", client.undo, "put the autopilot's values from before the last calibration back")
    undo.add_argument(
        "--force", action="store_true", help="leave what somebody else has changed since, and put the rest back"
    )
    setup.add_command(add)
    history = add("history", client.history, "list past calibrations")
    history.add_argument("-n", "--limit", type=_count, default=20, metavar="N", help="the latest N (default 20)")
    report.add_command(add, _count)
    add("monitor", monitor.monitor, "watch the daemon until Ctrl-C")
    add("web-token", local.web_token, "where the page is, and the token that its buttons need")
    recordings.add_commands(add)
    profile.add_command(add)
    ground.add_commands(commands, common)
    return parser


def seconds(text: str) -> float:
    """An argument that is a time.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time in seconds above 0")
    return value


def _count(text: str) -> int:
    value = int(text) if text.isdecimal() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def print_json(value: Any) -> None:
    """Print the one JSON object of a command."""
    print_lines(json.dumps(value))
