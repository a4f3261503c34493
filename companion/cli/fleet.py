"""`companion fleet ...`: collects the items of many aircraft in one database; for the ground, not for an aircraft."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
from collections.abc import Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from companion.cli.terminal import DONE, Parser, adder, print_lines
from companion.errors import ConfigError
from companion.links.system import logs

if TYPE_CHECKING:
    from companion.fleet.server import Server

DEFAULT_PAGE: Final = "127.0.0.1:8291"

_NEEDS_MORE: Final = (
    "companion fleet needs more than is installed: pip install '.[fleet]' in the folder of the companion's sources"
)


def add_commands(commands: argparse._SubParsersAction[Parser], common: Parser) -> None:
    words = "many aircraft: collect what they tell over MQTT in one database"
    fleet = commands.add_parser("fleet", help=words, description=words)
    add = adder(fleet.add_subparsers(title="commands", metavar="COMMAND", required=True), common)
    words = "collect, until Ctrl-C; -c names a file whose [mqtt] names the broker (default: this machine's)"
    run = add("run", _run, words)
    words = "postgresql://USER@HOST/NAME, or the path of an SQLite file (default fleet.sqlite, here)"
    run.add_argument("--database", default="fleet.sqlite", metavar="URL", help=words)
    words = f"address of the page (default {DEFAULT_PAGE}, for this computer alone; off: no page)"
    run.add_argument("--page", default=DEFAULT_PAGE, metavar="HOST:PORT", help=words)
    run.add_argument("--password-file", type=Path, metavar="FILE", help="file with the password of the page")
    acl = add("acl", _acl, "print a broker's access list: each aircraft below its own name, and the collector")
    acl.add_argument("broker", choices=("mosquitto",), help="format of the list")
    words = "user name of an aircraft and its id (default: each aircraft's user name is its id)"
    acl.add_argument("aircraft", nargs="*", metavar="USER=ID", help=words)


async def _run(options: argparse.Namespace) -> int:
    _check_installed()
    from companion.config.sections import Mqtt
    from companion.fleet.collector import Collector, load_broker
    from companion.fleet.store import Store

    mqtt = load_broker(options.config) if hasattr(options, "config") else Mqtt(host="127.0.0.1")
    logs.set_up("info")
    collector = Collector(mqtt, Store(options.database))
    pages = [] if options.page == "off" else [_server(options).run()]
    await _until_stopped(collector.run(), *pages)
    return DONE


async def _acl(options: argparse.Namespace) -> int:
    from companion.fleet.acl import access_list

    print_lines(*access_list(options.aircraft))
    return DONE


def _server(options: argparse.Namespace) -> Server:
    from companion.fleet.server import Server, read_password

    password = None if options.password_file is None else read_password(options.password_file)
    return Server(options.page, options.database, password)


async def _until_stopped(*runs: Coroutine[Any, Any, None]) -> None:
    """Run until Ctrl-C or SIGTERM, or until one fails, and raise what that raised; all have ended then."""
    from companion.fleet.collector import stop

    tasks = [asyncio.ensure_future(run) for run in runs]
    together = asyncio.gather(*tasks)
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, together.cancel)
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await together
    finally:
        await stop(tasks)


def _check_installed() -> None:
    try:
        import aiomqtt  # noqa: F401
        import psycopg  # noqa: F401
        import sqlalchemy  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"{_NEEDS_MORE} ({error})") from None
