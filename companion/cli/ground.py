"""Commands for other computers than the aircraft's: `companion ground ...` on a laptop, and `companion fleet ...`."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import importlib.util
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from companion.cli.terminal import (
    DONE,
    CommandGroup,
    Parser,
    add_fields,
    conclude,
    print_lines,
    request_of,
    seconds,
    within,
)
from companion.commands import Calibrate, Interface
from companion.errors import ConfigError, LinkError, NobodyHeardError
from companion.links.system.process import set_up_logs

if TYPE_CHECKING:
    from companion.ground.station import RequestOutcome, Station

URLS: Final = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:PATH:BAUD"
DEFAULT_URL: Final = "udpin:0.0.0.0:14550"
DEFAULT_PAGE: Final = "127.0.0.1:8291"

_NEEDS_MORE: Final = (
    "companion fleet needs more than is installed: pip install '.[fleet]' in the folder of the companion's sources"
)


def add_ground(commands: CommandGroup) -> None:
    link = Parser(add_help=False)
    link.add_argument("--url", type=_url, default=DEFAULT_URL, help=f"{URLS} (default {DEFAULT_URL})")
    option, of_byte = link.add_argument, within(1, 255, int)
    option("--system", type=of_byte, metavar="N", help="the vehicle's system id, where several are heard")
    option("--component", type=of_byte, default=191, metavar="N", help="the companion's component id (default 191)")
    option("--within", type=seconds, default=5.0, metavar="S", help="how long to look for the companion (default 5)")
    option("--signing-key-file", type=Path, metavar="FILE", help="sign, and believe nobody else (docs/security.md)")
    add = commands.group("ground", "the same from a laptop on the ground, over the telemetry link", link).add
    calibrate = add("calibrate", _calibrate, "calibrate now and show how it goes; Ctrl-C cancels")
    add_fields(calibrate, Calibrate, Interface.GROUND)
    for name, words in (
        ("status", "what the companion is doing, its last result and its settings"),
        ("cancel", "cancel what runs, whoever asked for it"),
        ("undo", "restore the autopilot's values from before the last write"),
    ):
        add(name, partial(_on_the_link, work=methodcaller(name)), words)


async def _calibrate(options: argparse.Namespace) -> int:
    wanted = Calibrate.read(request_of(options, Calibrate))
    return await _on_the_link(options, lambda one: one.calibrate(wanted.biases, wanted.timeout_s, reboot=wanted.reboot))


async def _on_the_link(options: argparse.Namespace, work: Callable[[Station], Awaitable[RequestOutcome]]) -> int:
    from companion.ground.heard import GroundListener
    from companion.ground.link import open_link
    from companion.ground.station import Display, Station

    key = None if options.signing_key_file is None else _key(options.signing_key_file)
    heard = GroundListener(options.component)
    # MAVSDK prints some of its errors on stdout, which is reserved for the answer.
    with contextlib.redirect_stdout(sys.stderr):
        async with open_link(options.url, heard, key) as link:
            station = Station(link, options.url, Display())
            try:
                await station.find(options.system, options.within)
            except NobodyHeardError as error:
                raise NobodyHeardError("; ".join(filter(None, (str(error), link.unbelieved())))) from None
            async with _interruptible(station):
                outcome = await work(station)
    return conclude(options, outcome.answer, outcome.lines, good=outcome.good)


@contextlib.asynccontextmanager
async def _interruptible(station: Station) -> AsyncIterator[None]:
    """Context in which Ctrl-C and SIGTERM cancel the request at the companion, instead of only ending this program."""
    loop = asyncio.get_running_loop()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}
    for number in numbers:
        loop.add_signal_handler(number, station.interrupt)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
            signal.signal(number, before[number])


def _key(path: Path) -> bytes:
    from companion.links.mavlink.signing import read_key

    try:
        return read_key(path)
    except LinkError as error:
        raise ConfigError(str(error)) from None


def _url(text: str) -> str:
    from companion.links.mavlink.transport import parse_url

    try:
        parse_url(text)
    except LinkError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


# --- fleet


def add_fleet(commands: CommandGroup) -> None:
    add = commands.group("fleet", "collect the reports of many aircraft over MQTT in one database").add
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
    if missing := [name for name in ("aiomqtt", "psycopg", "sqlalchemy") if importlib.util.find_spec(name) is None]:
        raise ConfigError(f"{_NEEDS_MORE} (no module {', '.join(missing)})")
    from companion.config.sections import Mqtt
    from companion.fleet.collector import Collector, load_broker
    from companion.fleet.store import Store

    mqtt = load_broker(options.config) if hasattr(options, "config") else Mqtt(host="127.0.0.1")
    set_up_logs("info")
    collector, pages = Collector(mqtt, Store(options.database)), []
    if options.page != "off":
        from companion.fleet.server import Server, read_password

        password = None if options.password_file is None else read_password(options.password_file)
        pages.append(Server(options.page, options.database, password).run())
    await _until_stopped([collector.run(), *pages])
    return DONE


async def _acl(options: argparse.Namespace) -> int:
    from companion.fleet.acl import access_list

    print_lines(*access_list(options.aircraft))
    return DONE


async def _until_stopped(runs: Sequence[Coroutine[Any, Any, None]]) -> None:
    """Run coroutines until Ctrl-C, SIGTERM or the first failure; stop all of them, then raise the failure."""
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
