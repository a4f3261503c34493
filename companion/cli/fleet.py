"""`companion fleet ...`: what many aircraft tell, in one database; on the ground, not on the aircraft."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Final

from companion.cli import logs
from companion.cli.terminal import DONE, Parser
from companion.errors import ConfigError

_NEEDS_MORE: Final = "companion fleet needs more than is installed: pip install 'companion[fleet]'"


def add_commands(commands: argparse._SubParsersAction[Parser], common: Parser) -> None:
    """Add `fleet` and its own commands."""
    words = "many aircraft: collect what they tell over MQTT in one database"
    fleet = commands.add_parser("fleet", help=words, description=words)
    subcommands = fleet.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(name: str, command: Callable[[argparse.Namespace], Awaitable[int]], words: str) -> argparse.ArgumentParser:
        sub = subcommands.add_parser(name, parents=[common], help=words, description=words)
        sub.set_defaults(command=command)
        return sub

    run = add(
        "run", _run, "collect, until Ctrl-C; -c names a file whose [mqtt] names the broker (default: this machine's)"
    )
    run.add_argument(
        "--database",
        default="fleet.sqlite",
        metavar="URL",
        help="postgresql://USER@HOST/NAME, or the path of an SQLite file (default fleet.sqlite, here)",
    )


async def _run(options: argparse.Namespace) -> int:
    """`companion fleet run`."""
    _check_installed()
    from companion.config.sections import Mqtt
    from companion.fleet import settings
    from companion.fleet.collector import Collector
    from companion.fleet.store import Store

    mqtt = settings.load(options.config).mqtt if hasattr(options, "config") else Mqtt(host="127.0.0.1")
    store = Store(options.database)
    logs.set_up("info")
    async with _until_stopped():
        await Collector(mqtt, store).run()
    return DONE


def _check_installed() -> None:
    try:
        import aiomqtt  # noqa: F401
        import psycopg  # noqa: F401
        import sqlalchemy  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"{_NEEDS_MORE} ({error})") from None


@contextlib.asynccontextmanager
async def _until_stopped() -> AsyncIterator[None]:
    """Ctrl-C and SIGTERM end what is inside, in order."""
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    stopped = False

    def stop() -> None:
        nonlocal stopped
        if task is not None:
            stopped = task.cancel()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop)
    try:
        yield
    except asyncio.CancelledError:
        if not stopped:
            raise
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)
