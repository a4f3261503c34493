"""`companion fleet ...`: what many aircraft tell, in one database; on the ground, not on the aircraft."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
import tempfile
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from companion.cli.terminal import DONE, Parser, print_lines
from companion.errors import ConfigError
from companion.links.system import logs

if TYPE_CHECKING:
    from companion.fleet.server import Server

DEFAULT_PAGE: Final = "127.0.0.1:8291"

_NEEDS_MORE: Final = (
    "companion fleet needs more than is installed: pip install '.[fleet]' in the folder of the companion's sources"
)


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
    demo = add("demo", _demo, "thirty simulated aircraft and the page, on this computer alone, until Ctrl-C")
    for command in (run, demo):
        command.add_argument(
            "--page",
            default=DEFAULT_PAGE,
            metavar="HOST:PORT",
            help=f"where the page is (default {DEFAULT_PAGE}: for this computer alone; off: no page)",
        )
        command.add_argument(
            "--password-file", type=Path, metavar="FILE", help="who looks at the page is asked for what is in it"
        )
        command.add_argument("--cert", type=Path, metavar="FILE", help="the page's certificate with its chain (PEM)")
        command.add_argument("--key", type=Path, metavar="FILE", help="its key; with both the page speaks https")
    acl = add("acl", _acl, "print a broker's access list: each aircraft below its own name, and the collector")
    acl.add_argument("broker", choices=("mosquitto", "emqx"), help="whose format")
    words = "which user is which aircraft, by its id (default: each aircraft's user name is its id)"
    acl.add_argument("aircraft", nargs="*", metavar="USER=ID", help=words)


async def _run(options: argparse.Namespace) -> int:
    """`companion fleet run`."""
    _check_installed()
    from companion.config.sections import Mqtt
    from companion.fleet import settings
    from companion.fleet.collector import Collector
    from companion.fleet.store import Store

    mqtt = settings.load(options.config).mqtt if hasattr(options, "config") else Mqtt(host="127.0.0.1")
    logs.set_up("info")
    collector = Collector(mqtt, Store(options.database))
    pages = [] if options.page == "off" else [_server(options, options.database).run()]
    await _until_stopped(collector.run(), *pages)
    return DONE


async def _demo(options: argparse.Namespace) -> int:
    """`companion fleet demo`."""
    _check_installed()
    from companion.fleet import demo
    from companion.fleet.store import Store

    logs.set_up("warning")
    with tempfile.TemporaryDirectory(prefix="companion-fleet-") as folder:
        database = Path(folder) / "fleet.sqlite"
        server = _server(options, str(database))
        Store(str(database)).prepare()  # whoever looks at once sees an empty fleet
        mosquitto = demo.find_mosquitto()
        beside = "Mosquitto" if mosquitto else "a broker of its own"
        print_lines(f"{demo.AIRCRAFT} simulated aircraft, {beside}, and an SQLite file in {folder}, until Ctrl-C")
        print_lines(f"look at {server.url}")
        await _until_stopped(demo.play(database, mosquitto), server.run())
    return DONE


async def _acl(options: argparse.Namespace) -> int:
    """`companion fleet acl`."""
    from companion.fleet.acl import access_list

    print_lines(*access_list(options.broker, options.aircraft))
    return DONE


def _server(options: argparse.Namespace, database: str) -> Server:
    from companion.fleet.certificate import Certificate
    from companion.fleet.server import Server, read_password

    password = None if options.password_file is None else read_password(options.password_file)
    if (options.cert is None) != (options.key is None):
        raise ConfigError("--cert and --key: found one of them; allowed: both, or neither")
    certificate = None if options.cert is None else Certificate(options.cert, options.key)
    return Server(options.page, database, password, certificate)


async def _until_stopped(*runs: Coroutine[Any, Any, None]) -> None:
    """Until Ctrl-C or SIGTERM, or the first of them fails, with what it raised; all have ended then."""
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
